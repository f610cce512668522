"""Every promise in docs/safety.md has a test, and every promise mark names a promise there."""

from __future__ import annotations

import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NIGHTLY = {"full", "e2e", "netem"}
"""Marks of tests that do not run before a landing."""


def promised() -> list[str]:
    """Read the names from the table of promises."""
    page = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
    table = page.partition("\n## Promises\n")[2].partition("\n## ")[0]
    return re.findall(r"^\| `([a-z-]+)` \|", table, re.MULTILINE)


def marks(nodes: list[ast.expr]) -> list[ast.expr]:
    """Give the expressions below `nodes` that are marks, without their calls' arguments."""
    flat = [each for node in nodes for each in getattr(node, "elts", [node])]
    return [each for each in flat if ast.unparse(each).startswith("pytest.mark.")]


def promises_of(path: Path) -> list[tuple[str, bool]]:
    """List the promise marks of a file's tests, and whether they run before a landing."""
    body = ast.parse(path.read_text(encoding="utf-8")).body
    shared = [
        mark
        for node in body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "pytestmark"
        for mark in marks([node.value])
    ]
    found = []
    for test in body:
        if isinstance(test, ast.FunctionDef) and test.name.startswith("test_"):
            own = [*shared, *marks(test.decorator_list)]
            daily = not {ast.unparse(mark).split(".")[2] for mark in own} & NIGHTLY
            for mark in own:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func).endswith(".promise"):
                    found.append((ast.literal_eval(mark.args[0]), daily))
    return found


def test_promises_and_their_marks_match() -> None:
    files = (ROOT / "tests").rglob("test_*.py")
    found = [each for path in files for each in promises_of(path)]
    names = promised()
    assert 15 <= len(names) == len(set(names)) <= 25
    assert {name for name, _ in found} - set(names) == set()
    assert set(names) - {name for name, daily in found if daily} == set()
