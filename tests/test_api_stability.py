"""`make api` sees what breaks a caller of a public module, and nothing else."""

import griffe
import pytest

from tools.api import PAGE, breaking_changes, public_modules

BEFORE = "def load(name, folder=None): ...\nclass Kept:\n    size = 1\n"


def visit(source):
    with griffe.temporary_visited_module(source, module_name="cloudrc") as module:
        return module


@pytest.mark.parametrize(
    ("source", "told"),
    [
        (BEFORE, 0),
        (BEFORE + "def more(): ...\n", 0),
        (BEFORE.replace(", folder=None", ""), 1),
        (BEFORE.replace("load", "read"), 1),
        (BEFORE.replace("    size = 1\n", "    pass\n"), 1),
    ],
)
def test_a_change_of_a_public_module_is_told_if_it_breaks_a_caller(source, told):
    before, now = visit(BEFORE), visit(source)
    assert len(list(breaking_changes(before, now, {"cloudrc"}))) == told
    assert not list(breaking_changes(before, now, {"cloudrc.other"}))


@pytest.mark.parametrize(("now", "told"), [("from own.api import fly\n", 0), ("", 1)])
def test_a_name_that_a_module_no_longer_hands_on_is_told_there(now, told):
    def package(source):
        files = {"__init__.py": source, "api.py": "def fly(): ...\n"}
        return griffe.temporary_visited_package("own", files)

    exported = '__all__ = ["fly"]\n'
    with (
        package(f"from own.api import fly\n{exported}") as before,
        package(now + exported * bool(now)) as after,
    ):
        assert len(list(breaking_changes(before, after, {"own"}))) == told


def test_the_page_lists_modules_that_exist():
    assert "cloudrc" in public_modules(PAGE.read_text())
    root = PAGE.parents[1]
    modules = public_modules(PAGE.read_text())
    assert modules
    for module in modules:
        path = root.joinpath(*module.split("."))
        assert path.with_suffix(".py").is_file() or (path / "__init__.py").is_file(), module
