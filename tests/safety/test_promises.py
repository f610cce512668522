"""Every promise in docs/safety.md has a test, and every promise mark names a promise there."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NIGHTLY = {"full", "e2e", "netem"}
"""Marks of tests that do not run before a landing."""


def promises_of(path):
    """List the promise marks of a file's tests, and whether they run before a landing."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    shared = [each.value for each in body if isinstance(each, ast.Assign)]
    found = []
    for test in body:
        if isinstance(test, ast.FunctionDef) and test.name.startswith("test_"):
            nodes = [flat for each in (*shared, *test.decorator_list)
                     for flat in getattr(each, "elts", [each])]  # fmt: skip
            marks = [
                text for each in nodes if (text := ast.unparse(each)).startswith("pytest.mark.")
            ]
            daily = not {re.split(r"\W", mark)[2] for mark in marks} & NIGHTLY
            names = (re.match(r"pytest\.mark\.promise\('(.*)'\)", mark) for mark in marks)
            found += [(name[1], daily) for name in names if name]
    return found


def test_promises_and_their_marks_match():
    found = [each for path in (ROOT / "tests").rglob("test_*.py") for each in promises_of(path)]
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    table = page.partition("\n## Promises\n")[2].partition("\n## ")[0]
    names = re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE)
    assert 15 <= len(names) == len(set(names)) <= 25
    assert {name for name, _ in found} - set(names) == set()
    assert set(names) - {name for name, daily in found if daily} == set()
