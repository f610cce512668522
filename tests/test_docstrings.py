# SPDX-License-Identifier: Apache-2.0

"""Every float, vector and array in a public docstring has its unit.

A unit is in brackets: [s], [m/s]; [1] means no unit. "Likewise" means the unit of the line above.
A share "in [0, 1]", a unit vector and a unit quaternion have no unit. A function for numbers of any
unit says "any unit".
"""

import ast
import re
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[1] / "cloudrc"
FILES = sorted(PACKAGE.rglob("*.py"))

UNIT = re.compile(
    r"\[[^\],]+\]|\blikewise\b|\bany unit\b|\bin \[0, 1\]|\bunit (vector|quaternion)\b",
    re.IGNORECASE,
)
ENTRY = re.compile(r"^    (\w+): ", re.MULTILINE)
RECORDS = {"dataclass", "NamedTuple"}
QUANTITIES = {"float", "Vector", "Quaternion", "Array"}

EXCEPTIONS = {"Number"}
"""Classes whose floats have no fixed unit: a Number has a field `unit`."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def public(tree):
    """Yield the public classes with their methods, and the public functions."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node
            yield from (method for method in node.body if isinstance(method, Function))
        elif isinstance(node, Function):
            yield node


def quantities(node, lines):
    """Yield the arguments or fields that need a unit, with the comments beside the fields."""
    if isinstance(node, ast.ClassDef):
        marks = [ast.unparse(mark) for mark in (*node.decorator_list, *node.bases)]
        is_record = any(mark.partition("(")[0] in RECORDS for mark in marks)
        found = [each for each in node.body if is_record and isinstance(each, ast.AnnAssign)]
    else:
        found = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    for each in found:
        kind = ast.unparse(each.annotation) if each.annotation else ""
        if kind.removesuffix(" | None") in QUANTITIES:
            is_field = isinstance(each, ast.AnnAssign)
            beside = lines[each.lineno - 1].partition("  # ")[2] if is_field else ""
            yield ast.unparse(each.target) if is_field else each.arg, beside


def without_unit(source):
    """Return the quantities without a unit, as "function: argument"."""
    found, lines = [], source.splitlines()
    for node in public(ast.parse(source)):
        said = ast.get_docstring(node)
        if said is None or node.name in EXCEPTIONS or re.match(r"_[^_]", node.name):
            continue
        pieces = ENTRY.split(said)[1:]
        entries = dict(zip(pieces[::2], pieces[1::2], strict=True))
        for name, beside in quantities(node, lines):
            # A quantity without an entry has its unit in the sentence: "after `seconds` [s]".
            told = re.search(rf"\b{name.replace('_', '[_ ]')}\b", said)
            if not UNIT.search(entries.get(name, said if told else "") + beside):
                found.append(f"{node.name}: {name}")
    return found


def test_every_quantity_has_its_unit():
    found = {str(path.relative_to(PACKAGE)): without_unit(path.read_text()) for path in FILES}
    assert {path: missing for path, missing in found.items() if missing} == {}
