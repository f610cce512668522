# SPDX-License-Identifier: Apache-2.0

"""Read which faults the tests inject, from their marks: the tables of docs/reference/faults.md."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.faults.scenarios import SCENARIOS
from tools.markdown import table

TESTS = Path(__file__).resolve().parents[1] / "tests"
LAST = 40
"""Number of the last fault, F40."""


def marks() -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield number and texts of each mark `fault` with its values in the source of a test."""
    for path in sorted(TESTS.rglob("test_*.py")):
        if "pytest.mark.fault(" not in (source := path.read_text("utf-8")):
            continue
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.fault":
                number, name = node.args
                if isinstance(number, ast.Constant):
                    texts = {str(each.arg): ast.literal_eval(each.value) for each in node.keywords}
                    yield number.value, {"name": ast.literal_eval(name), **texts}


def numbers() -> set[int]:
    """Return the numbers of the faults that tests inject."""
    return {each.number for each in SCENARIOS.values()} | {number for number, _ in marks()}


def named() -> str:
    """Format the table of the faults that are injected in virtual time."""
    rows = [(each.id, each.name, each.injects, each.expects) for each in SCENARIOS.values()]
    return table("number | name | what happens | what is required", rows)


def others() -> str:
    """Format the table of the faults that need processes, a disk or a cluster."""
    rows = [
        (f"F{number}", each["name"], each["injects"], each["expects"], each.get("figures", "-"))
        for number, each in sorted(marks(), key=lambda mark: (mark[0], mark[1]["name"]))
    ]
    return table("number | name | what happens | what is required | figures", rows)
