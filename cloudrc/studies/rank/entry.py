# SPDX-License-Identifier: Apache-2.0

"""The file of an entry: what a policy has done, and how this was found out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

from cloudrc.base.files import read_json, write_json
from cloudrc.base.outside.refusal import naming, reading
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.studies.rank.score import Results, score
from cloudrc.studies.rank.tasks import CONDITIONS, SEEDS, TASKS, VERSION, pinned

FAILED = {"score_ms": None, "score": "failed", "area": 0.0, "of": 0}
"""Score of a policy that gave a wrong answer, or none."""
OF_A_DAY = ("date", "answer", "sha256")
"""What differs between two entries that are the same."""
TEXTS = ("rank", "task", "policy", "executor", "failed", "answer", "code", "command", "date")
"""Keys of an entry whose values are texts."""


def write_entry(path: Path, content: Mapping[str, Any]) -> dict[str, Any]:
    """Write an entry; if one of the same content is there, it stays as it is. Return it."""
    sealed = {**content, "sha256": _seal(content)}
    had = read_json(path)
    if _lasting(had) == _lasting(json.loads(json.dumps(sealed))):
        return had
    write_json(path, sealed)
    return sealed


def _lasting(entry: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in entry.items() if key not in OF_A_DAY}


def _seal(entry: Mapping[str, Any]) -> str:
    content = {key: value for key, value in entry.items() if key != "sha256"}
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_entry(path: Path) -> dict[str, Any]:
    """Read an entry of this version; raise an error that says why it is none."""
    entry = read_json(path)
    with naming(str(path)), reading(path, "is no entry of 'cloudrc rank'"):
        if not path.is_file():
            raise InvalidValueError("there is no such file")
        _check(entry)
    return entry


def _check(entry: Mapping[str, Any]) -> None:
    if wrong := [key for key in TEXTS if type(entry.get(key)) is not str]:
        raise InvalidValueError(f"it has no text {', '.join(wrong)}")
    if (version := entry["rank"]) != VERSION:
        raise InvalidValueError(f"is of version {version}; this cloudrc ranks version {VERSION}")
    if (task := entry["task"]) not in TASKS or entry["executor"] not in TASKS[task].executors:
        raise InvalidValueError(f"has a task or executor that version {VERSION} has not")
    told, right = entry["hashes"], pinned(task)
    if wrong := [name for name in right if told.get(name) != right[name]]:
        raise InvalidValueError(f"has another {', '.join(wrong)} than version {VERSION}: its hash")
    results: Results = entry["results"]
    if results and entry["failed"]:
        raise InvalidValueError("was edited: it has results, and says that the policy failed")
    if not entry["failed"]:
        _check_seeds(results)
    found = score(results) if results else FAILED
    if _seal(entry) != entry["sha256"] or any(entry[key] != found[key] for key in found):
        raise InvalidValueError("was edited: its hash is not that of its content; play it again")
    if type(entry["versions"]["cloudrc"]) is not str:
        raise InvalidValueError("does not say with which cloudrc it was played")


def _check_seeds(results: Results) -> None:
    conditions = [(each["link"], each["rtt_ms"]) for each in results]
    if conditions != [*CONDITIONS]:
        raise InvalidValueError("has other links or round trips")
    for each in results:
        if (count := len(each["success"])) != len(SEEDS):
            rtt = "" if each["rtt_ms"] is None else f" at {each['rtt_ms']:g} ms"
            text = f"has {count} seeds in place of {len(SEEDS)}: {each['link']}{rtt}"
            raise InvalidValueError(text)
