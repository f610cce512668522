# SPDX-License-Identifier: Apache-2.0

"""Compare the public Python API with an earlier commit: `make api`.

docs/api.md lists the public names. After the first release, a change that breaks a caller ends with
exit code 1. Before, changes are only listed.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import griffe

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "api.md"


def public_names(page: str) -> set[str]:
    """Return the names in the table of docs/api.md, each with its module."""
    rows = re.findall(r"^\| `(cloudrc[\w.]*)` \| (`[^|]+`) \|", page, re.MULTILINE)
    return {f"{module}.{name}" for module, names in rows for name in re.findall(r"\w+", names)}


def last_release() -> str | None:
    """Return the newest tag such as v1.2.3 in this commit's history; None if there is none."""
    command = ["git", "describe", "--tags", "--abbrev=0", "--match", "v[0-9]*"]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    return found.stdout.strip() or None


def paths_of(package: griffe.Object | griffe.Alias, name: str) -> Iterator[str]:
    """Yield a public name, where the package defines it, and the class that it returns."""
    yield name
    try:
        found = package[name.removeprefix(f"{package.path}.")]
    except KeyError:
        return
    yield found.canonical_path
    if isinstance(returned := getattr(found, "returns", None), griffe.Expr):
        yield returned.canonical_path


def breaking_changes(
    before: griffe.Object | griffe.Alias, now: griffe.Object | griffe.Alias, names: set[str]
) -> Iterator[str]:
    """Describe each difference between two packages that breaks a caller of `names`."""
    public = {path for name in names for one in (before, now) for path in paths_of(one, name)}
    for change in griffe.find_breaking_changes(before, now):
        # A member belongs to its class. Upwards by parents: an imported name keeps its own path.
        found = change.obj
        while found.path not in public and found.parent is not None:
            found = found.parent
        if found.path in public:
            yield change.explain(griffe.ExplanationStyle.ONE_LINE)


def main() -> int:
    """Print the breaking changes since the commit in the first argument, or since the release."""
    release = last_release()
    base = sys.argv[1] if len(sys.argv) > 1 else release
    if base is None:
        print("no release yet: name a commit to compare with, such as 'make api SINCE=HEAD~10'")
        return 0
    before = griffe.load_git("cloudrc", ref=base, repo=ROOT)
    now = griffe.load("cloudrc", search_paths=[ROOT])
    found = list(breaking_changes(before, now, public_names(PAGE.read_text())))
    print("\n".join(found) or f"the public API has no breaking change since {base}")
    return 1 if found and release else 0


if __name__ == "__main__":
    sys.exit(main())
