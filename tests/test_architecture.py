# SPDX-License-Identifier: Apache-2.0

"""The import rules of the package and the sizes of its functions."""

import ast
import re
import sys
import tomllib
from collections import Counter
from functools import cache
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

from tests.support.commands import python
from tools.wings import guests

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "cloudrc"
FILES = sorted(PACKAGE.rglob("*.py"))

ROS = (
    *("rclpy", "diagnostic_msgs", "geometry_msgs", "nav_msgs", "rosgraph_msgs", "sensor_msgs"),
    *("std_msgs", "std_srvs", "nav2_msgs", "tf2_msgs", "visualization_msgs"),
)
"""Packages of a sourced ROS 2, which no package registry is asked for."""
# Imported package -> its name in pyproject.toml.
ASKED_AS = {
    "yaml": "pyyaml",
    **dict.fromkeys(("pydantic_core", "annotated_types"), "pydantic"),
    "urllib3": "kubernetes",
    "foxglove": "foxglove_sdk",
    "PIL": "pillow",
    "OpenGL": "pyopengl",
}


@cache
def trees():
    """Return the tree of each file of the package."""
    return {path: ast.parse(path.read_text()) for path in FILES}


@cache
def nodes_of(tree):
    """Return all nodes of a tree: to walk over them takes longer than each check."""
    return tuple(ast.walk(tree))


@pytest.fixture(scope="module", autouse=True)
def trees_are_forgotten():
    """Let no later garbage collection visit a million nodes."""
    yield
    for kept in (trees, nodes_of, imports):
        kept.cache_clear()


def place_of(path):
    return path.relative_to(PACKAGE).as_posix()


@cache
def imports(tree):
    """Return the names of all imported modules, anywhere in the file."""
    found = set()
    for node in nodes_of(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative import"
            found.add(node.module)
    return found


def test_the_contracts_of_imports_hold(monkeypatch, capsys):
    """Ruff checks clocks, sockets, threads, signals, chance, and calls such as `eval`."""
    monkeypatch.chdir(ROOT)
    assert lint_imports(no_cache=True) == 0, capsys.readouterr().out


def test_no_text_of_the_core_names_a_guest():
    """The contract `layers` sees import statements alone."""
    above = guests()
    names = tuple(f"cloudrc.{wing}" for wing in above)
    named = {
        f"{place_of(path)}: {node.value}"
        for path, tree in trees().items()
        if path.parent != PACKAGE and path.relative_to(PACKAGE).parts[0] not in above
        for node in nodes_of(tree)
        if isinstance(node, ast.Constant) and str(node.value).startswith(names)
    }
    assert named == set()


def test_no_remedy_is_cut_out_of_a_sentence():
    """But of the error in a pod's log, which comes as text."""
    cut = {place_of(path) for path in FILES if '.partition("; ")' in path.read_text()}
    assert cut == {"cluster/pods.py"}


def test_live_metrics_load_neither_recordings_nor_heavy_libraries():
    heavy = {"cloudrc.results.record", "cloudrc.config", "pydantic", "numpy"}
    program = f"import sys, cloudrc.results.exposition.live; print({heavy} & sys.modules.keys())"
    found = python("-c", program)
    assert found.stdout == "set()\n", found.stderr


def foreign(parsed):
    """Return the imported external packages by their names in pyproject.toml."""
    found = {name.partition(".")[0] for tree in parsed for name in imports(tree)}
    found -= sys.stdlib_module_names | {"cloudrc", *ROS}
    return {ASKED_AS.get(name, name) for name in found}


def test_imported_and_declared_packages_are_the_same():
    """A package with a wrong, similar name in pyproject.toml fails this test."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    optional = project["optional-dependencies"].items()
    extras = [lines for name, lines in optional if name not in ("dev", "deep")]
    lines = sum(extras, project["dependencies"])
    declared = {re.split(r"[<>=\[; ]", line)[0].replace("-", "_") for line in lines} - {"cloudrc"}
    assert foreign(trees().values()) == declared
    assert foreign([ast.parse("def f():\n    from polaris.client import get")]) == {"polaris"}


def test_no_function_is_too_long():
    long = set()
    for path, tree in trees().items():
        for node in nodes_of(tree):
            function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            if function and node.end_lineno - node.lineno >= 80:
                long.add(f"{place_of(path)}: {node.name}")
    assert long == set()


PUBLIC = {"_asdict", "_fields", "_replace", "_exit"}
"""Names that Python documents for everybody."""
NO_OTHER_NAME = {"_address", "_add_info"}
"""Of mujoco and gymnasium, which have no public name for it."""


def private_of_others(parsed):
    """Return the private names that no file of the package gives to anything, and imported ones."""
    used, own = set(), set()
    for node in (node for tree in parsed for node in nodes_of(tree)):
        match node:
            case ast.Attribute(attr=name, ctx=ast.Load()):
                used.add(name)
            case ast.ImportFrom(module=module, names=names) if not module.startswith("cloudrc"):
                used |= {part for part in module.split(".") if part != "__future__"}
                used |= {alias.name for alias in names}
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name):
                own.add(name)
            case ast.ClassDef(name=name, body=body):
                own.add(name)
                own |= {each.target.id for each in body if isinstance(each, ast.AnnAssign)}
                sets = (each.targets for each in body if isinstance(each, ast.Assign))
                own |= {one.id for each in sets for one in each if isinstance(one, ast.Name)}
            case ast.Attribute(attr=name, ctx=ast.Store()):
                own.add(name)
    return {name for name in used - own if name.startswith("_") and not name.endswith("_")}


def test_no_private_name_of_another_package_is_used():
    assert private_of_others(trees().values()) - PUBLIC - NO_OTHER_NAME == set()
    for text in ("chart._queue_update(1)", "import a\na._b", "from a._b import c", "x.y._z"):
        assert private_of_others([ast.parse(text)]), text
    assert private_of_others([ast.parse("def f(self):\n    self._a = 1\n    self._a")]) == set()


def test_no_two_public_classes_share_a_name():
    found = Counter(
        node.name
        for tree in trees().values()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    )
    assert {name for name, count in found.items() if count > 1} == set()
