"""The page of threats: each of the specification has its row, and what that names is there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "safety" / "threats.md"
PROMISE = re.compile(r"\[P-[A-Z]+-\d+\]")
"""That a promise which a page names is there is held by `test_promises.py`."""
TEST = re.compile(r"`(tests/[\w/]+\.py)::(test_\w+)`")
ROW = re.compile(r"^\| (T\d+) \| (.+) \| (.+) \| (.+) \|$", re.MULTILINE)
THREATS = 23


def rows() -> list[tuple[str, ...]]:
    return ROW.findall(PAGE.read_text(encoding="utf-8"))


def named_in(path: str) -> set[str]:
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def test_every_threat_has_its_row() -> None:
    assert [name for name, *_ in rows()] == [f"T{n}" for n in range(1, THREATS + 1)]


def test_every_row_names_what_shows_it_and_nothing_else() -> None:
    for name, _, _, shown in rows():
        rest = TEST.sub("", PROMISE.sub("", shown))
        assert re.fullmatch(r"[ ,]*", rest), (name, rest)
        assert shown != rest, name


def test_the_tests_that_a_row_names_are_there() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert [pair for pair in TEST.findall(text) if pair[1] not in named_in(pair[0])] == []
