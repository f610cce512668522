# SPDX-License-Identifier: Apache-2.0

"""Run a command of cloudrc as a user does; keep its exit code and what it says."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

VOLATILE = {
    *("key", "code", "command", "date", "versions", "version", "environment", "machine", "wall_s"),
    *("seconds", "took_s", "created", "started", "python", "host", "cite", "commit", "folder"),
}
"""Keys of JSON documents that differ from run to run, from commit to commit or between machines."""


def cloudrc(*words: str) -> tuple[int, str, str]:
    """Run `cloudrc WORDS` in the working folder; return exit code, stdout and stderr."""
    command = [sys.executable, "-m", "cloudrc", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=280, check=False)
    return done.returncode, done.stdout, done.stderr


def document(*words: str) -> dict[str, Any]:
    """Run a command with `-o json`; return its exit code and its document."""
    code, out, err = cloudrc(*words, "-o", "json")
    try:
        found = stable(json.loads(out))
    except ValueError:
        found = f"{out[:400]} {err[:400]}"
    return {"exit": code, "document": found}


def rows(text: str) -> list[Any]:
    """Return the documents of a file with one JSON document per line, sorted."""
    found = [stable(json.loads(line)) for line in text.splitlines()]
    return sorted(found, key=lambda each: json.dumps(each, sort_keys=True))


def stable(value: Any) -> Any:
    """Return a JSON document without the keys that are not the same twice."""
    if isinstance(value, dict):
        return {key: stable(each) for key, each in value.items() if key not in VOLATILE}
    return [stable(each) for each in value] if isinstance(value, list) else value
