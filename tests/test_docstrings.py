"""Every float, vector and array in a public docstring has its unit.

A unit is in brackets: [s], [m/s]; [1] means no unit. "Likewise" means the unit of the line above.
A share "in [0, 1]", a unit vector and a unit quaternion have no unit. A function for numbers of any
unit says "any unit".
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "cloudrc"
FILES = sorted(PACKAGE.rglob("*.py"))

UNIT = re.compile(
    r"\[[^\],]+\]|\blikewise\b|\bany unit\b|\bin \[0, 1\]|\bunit (vector|quaternion)\b",
    re.IGNORECASE,
)
ENTRY = re.compile(r"^    (\w+): ", re.MULTILINE)
RECORDS = {"dataclass", "NamedTuple"}
QUANTITIES = {"float", "Vector", "Quaternion", "Array"}

# Function or class -> why its floats have no fixed unit.
EXCEPTIONS = {
    "Number": "its `unit` is a field of its own",
}

Function = ast.FunctionDef | ast.AsyncFunctionDef


def is_quantity(annotation: ast.expr | None) -> bool:
    """Tell whether an annotation is a float, vector or array, or None besides."""
    return annotation is not None and (
        ast.unparse(annotation).removesuffix(" | None") in QUANTITIES
    )


def is_record(node: ast.ClassDef) -> bool:
    """Tell whether the attributes of a class are its fields."""
    marks = [ast.unparse(mark) for mark in (*node.decorator_list, *node.bases)]
    return any(mark.partition("(")[0] in RECORDS for mark in marks)


def public(tree: ast.Module) -> Iterator[Function | ast.ClassDef]:
    """Yield the public classes with their methods, and all functions."""
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            yield node
            yield from (method for method in node.body if isinstance(method, Function))
        elif isinstance(node, Function):
            yield node


def quantities(node: Function | ast.ClassDef) -> list[str]:
    """Return the names of the arguments or fields that need a unit."""
    if isinstance(node, ast.ClassDef):
        fields = [field for field in node.body if isinstance(field, ast.AnnAssign)]
        named = [(ast.unparse(field.target), field.annotation) for field in fields]
        return [name for name, kind in named if is_record(node) and is_quantity(kind)]
    arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
    return [argument.arg for argument in arguments if is_quantity(argument.annotation)]


def comments(node: Function | ast.ClassDef, lines: list[str]) -> dict[str, str]:
    """Return the comments beside the fields of a class."""
    fields = [field for field in node.body if isinstance(field, ast.AnnAssign)]
    return {ast.unparse(f.target): lines[f.lineno - 1].partition("  # ")[2] for f in fields}


def without_unit(source: str) -> list[str]:
    """Return the quantities without a unit, as "function: argument"."""
    found, lines = [], source.splitlines()
    for node in public(ast.parse(source)):
        said = ast.get_docstring(node)
        if said is None or node.name in EXCEPTIONS or re.match(r"_[^_]", node.name):
            continue
        pieces = ENTRY.split(said)[1:]
        entries = dict(zip(pieces[::2], pieces[1::2], strict=True))
        beside = comments(node, lines) if isinstance(node, ast.ClassDef) else {}
        for name in quantities(node):
            # A quantity without an entry has its unit in the sentence: "after `seconds` [s]".
            told = re.search(rf"\b{name.replace('_', '[_ ]')}\b", said)
            text = entries.get(name, said if told else "") + beside.get(name, "")
            if not UNIT.search(text):
                found.append(f"{node.name}: {name}")
    return found


def test_every_quantity_has_its_unit() -> None:
    found = {str(path.relative_to(PACKAGE)): without_unit(path.read_text()) for path in FILES}
    assert {path: missing for path, missing in found.items() if missing} == {}


@pytest.mark.parametrize(
    ("code", "missing"),
    [
        ('def f(x: float):\n    """Move.\n\n    Args:\n        x: How far [m].\n    """', []),
        ('def f(x: float):\n    """Move.\n\n    Args:\n        x: How far.\n    """', ["f: x"]),
        ('def f(x: float):\n    """Move by `x` [m]."""', []),
        ('def f(x: float | None):\n    """Move by `x`."""', ["f: x"]),
        ('def f(x: float):\n    """Move [m]."""', ["f: x"]),
        ('class A(NamedTuple):\n    """A."""\n    x: float', ["A: x"]),
        ('@dataclass(frozen=True)\nclass A:\n    """A."""\n    x: float', ["A: x"]),
        ('class A(NamedTuple):\n    """A."""\n    x: float  # way [m]', []),
        ('class A:\n    """A."""\n    x: float', []),
    ],
)
def test_a_missing_unit_is_found(code: str, missing: list[str]) -> None:
    assert without_unit(code) == missing
