"""Each promise in the docs has an id and a test that carries it; each such test holds a promise."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROMISE = re.compile(r"\[(P-[A-Z]+-\d+)\]")
DOCUMENTS = [
    ROOT / "SECURITY.md",
    ROOT / "README.md",
    ROOT / "charts" / "cloudrc" / "README.md",
    *sorted((ROOT / "docs").rglob("*.md")),
]


def promised() -> list[str]:
    """Every id that the docs define: in bold at the beginning of a line or of a table's row."""
    text = (ROOT / "docs" / "safety" / "promises.md").read_text(encoding="utf-8")
    return re.findall(r"^\| \[(P-[A-Z]+-\d+)\] \|", text, re.MULTILINE)


def mentioned() -> set[str]:
    return {
        name
        for path in DOCUMENTS
        if path.exists()
        for name in PROMISE.findall(path.read_text(encoding="utf-8"))
    }


def held(source: str) -> list[str]:
    """Ids on the tests of a file, as `@pytest.mark.promise("P-...")` or in its `pytestmark`."""
    return [
        str(node.args[0].value)
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Call)
        and ast.unparse(node.func) == "pytest.mark.promise"
        and isinstance(node.args[0], ast.Constant)
    ]


def all_held() -> set[str]:
    files = (ROOT / "tests").rglob("test_*.py")
    return {name for path in files for name in held(path.read_text(encoding="utf-8"))}


def test_every_promise_has_a_test() -> None:
    assert sorted(set(promised()) - all_held()) == []


def test_every_mark_has_a_promise() -> None:
    assert sorted(all_held() - set(promised())) == []


def test_every_mention_has_a_promise_and_no_promise_is_given_twice() -> None:
    assert sorted(mentioned() - set(promised())) == []
    assert len(set(promised())) == len(promised()) > 10


def test_a_promise_is_skipped_nowhere() -> None:
    """A test that may be skipped holds nothing."""
    skipping = []
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                marks = [ast.unparse(mark) for mark in node.decorator_list]
                promises = any(mark.startswith("pytest.mark.promise") for mark in marks)
                if promises and any("skip" in mark or "xfail" in mark for mark in marks):
                    skipping.append(f"{path.name}: {node.name}")
    assert skipping == []


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('@pytest.mark.promise("P-A-1")\ndef test_a(): ...', ["P-A-1"]),
        ('pytestmark = [pytest.mark.promise("P-A-1"), pytest.mark.promise("P-B-2")]',
         ["P-A-1", "P-B-2"]),
        ('"""pytest.mark.promise("P-A-1")"""', []),
        ('# pytest.mark.promise("P-A-1")', []),
    ],
)  # fmt: skip
def test_a_mark_is_read_from_the_code_alone(source: str, found: list[str]) -> None:
    assert held(source) == found
