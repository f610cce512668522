# SPDX-License-Identifier: Apache-2.0

"""`make api` sees what breaks a caller of a public name, and nothing else."""

import re

import griffe
import pytest

from tools.api import PAGE, breaking_changes, public_names

ROOT = PAGE.parents[1]
PAGES = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
BEFORE = """
def load(name, folder=None) -> Kept: ...
class Kept:
    size = 1
    _own = 2
"""


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
        (BEFORE.replace("    size = 1\n", ""), 1),
        (BEFORE.replace("    _own = 2\n", ""), 0),
    ],
)
def test_a_change_of_a_public_name_is_told_if_it_breaks_a_caller(source, told):
    before, now = visit(BEFORE), visit(source)
    assert len(list(breaking_changes(before, now, {"cloudrc.load"}))) == told
    assert not list(breaking_changes(before, now, {"cloudrc.other"}))


def names_in(module):
    """Return the names that the source of a module defines or imports."""
    path = ROOT.joinpath(*module.split("."))
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return griffe.visit(module, file, file.read_text()).members.keys()


def test_the_page_lists_names_that_exist_and_all_that_examples_of_the_docs_import():
    listed = public_names(PAGE.read_text())
    modules = {name.rpartition(".")[0] for name in listed}
    assert listed <= {f"{module}.{name}" for module in modules for name in names_in(module)}
    text = "\n".join(page.read_text() for page in PAGES)
    imported = re.findall(r"^ *from (cloudrc[\w.]*) import (.+)$", text, re.MULTILINE)
    assert imported
    names = {f"{module}.{name}" for module, names in imported for name in names.split(", ")}
    assert names <= listed
