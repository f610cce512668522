# SPDX-License-Identifier: Apache-2.0

"""Modules beside a plug-in: its import statements find them."""

import logging
import sys
from pathlib import Path
from textwrap import dedent

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.code import load_file, sources
from cloudrc.base.plugins import find


@pytest.fixture
def write(tmp_path):
    """Return a function that writes files, path -> source, and returns their folder."""

    def make(**files):
        for name, text in files.items():
            path = tmp_path / f"{name.replace('__', '/')}.py"
            path.parent.mkdir(exist_ok=True, parents=True)
            path.write_text(text)
        return tmp_path

    return make


IMPORTS = {
    "import helper\nvalue = helper.value": "an import",
    "from helper import value": "a name of it",
    "import package.inner\nvalue = package.inner.value": "a module of a package",
    "from package import inner\nvalue = inner.value": "a module from a package",
    "from chain import value": "a module that imports another one",
    "def late():\n    import helper\n    return helper.value\nvalue = late()": "a late import",
}


@pytest.mark.parametrize("text", IMPORTS, ids=IMPORTS.values())
def test_every_form_of_import_finds_what_is_beside(write, text):
    folder = write(
        helper="value = 3",
        package__inner="value = 3",
        package__deep="from helper import value",
        chain="from helper import value",
        mine=text,
    )
    (folder / "package" / "__init__.py").write_text("from package.inner import value")
    assert load_file(folder / "mine.py").value == 3
    assert [*folder.rglob("__pycache__")] == []


def test_helpers_of_the_same_name_do_not_mix(write):
    source = "import helper, package.inner as inner"
    helpers = {"a__helper": "value = 1", "b__helper": "value = 2"}
    helpers |= {"a__package__inner": "value = 1", "b__package__inner": "value = 2"}
    folder = write(a__mine=source, b__mine=source, **helpers)
    found = [load_file(folder / name / "mine.py") for name in "aba"]
    assert [each.helper.value for each in found] == [1, 2, 1]
    assert [each.inner.value for each in found] == [1, 2, 1]


def test_a_changed_helper_counts_at_the_next_load(write):
    folder = write(mine="from helper import value", helper="value = 1")
    assert load_file(folder / "mine.py").value == 1
    write(helper="value = 2")
    assert load_file(folder / "mine.py").value == 2


@pytest.mark.parametrize(
    ("helper", "said"),
    [
        ("1 / 0", "helper.py:1: ZeroDivisionError: division by zero"),
        ("def x(:", r"SyntaxError: .*helper.py, line 1"),
    ],
)
def test_a_broken_helper_is_one_error_of_the_plug_in(write, helper, said):
    folder = write(mine="from helper import value", helper=helper)
    with pytest.raises(BadInputError, match=rf"mine.py' cannot be imported: {said}"):
        find("predictors", str(folder / "mine.py"))


def names(files, folder):
    return {str(Path(each).relative_to(folder)) for each in files}


def test_the_sources_of_a_plug_in_are_all_files_that_it_imports(write):
    folder = write(
        mine="import helper\ndef late():\n    from package import deep\n    import numpy, os",
        helper="from other import value",
        other="import mine",  # a circle
        package__deep="from third import value",
        third="",
        unused="",
    )
    (folder / "package" / "__init__.py").touch()
    wanted = {"mine.py", "helper.py", "other.py", "package/__init__.py", "package/deep.py"}
    assert names(sources(folder / "mine.py"), folder) == wanted | {"third.py"}
    assert sources(folder / "trace.csv") == [folder / "trace.csv"]
    write(mine="def build(:")
    assert sources(folder / "mine.py") == [folder / "mine.py"]


def test_data_files_that_a_plug_in_names_are_sources(write):
    """A sweep went on with other gains, because its keys did not depend on them."""
    text = """
        import helper
        gains = HERE / "gains.json"
        nested = "data/weights.npz"
        missing, folder, absolute = "missing.csv", "data", "/etc/hostname"
        odd = "a\\0b", "\\ud800", "", "x" * 5000, b"bytes.bin"
    """
    outer = write(inside__mine=dedent(text), inside__helper='other = "../shared.csv"', unnamed="")
    folder = outer / "inside"
    (folder / "data").mkdir()
    for name in ("gains.json", "data/weights.npz", "../shared.csv", "bytes.bin", "log.txt"):
        (folder / name).touch()
    inside = {"data/weights.npz", "gains.json", "helper.py", "mine.py"}
    wanted = {f"inside/{name}" for name in inside} | {"shared.csv"}
    assert names(sources(folder / "mine.py"), outer) == wanted


def test_looks_at_a_plugin_and_its_use_execute_it_once_and_every_use_executes_it_anew(
    write, monkeypatch
):
    executions = []
    monkeypatch.setattr(sys, "executions", executions, raising=False)
    path = write(plugin="import sys; sys.executions.append(1)") / "plugin.py"
    assert load_file(path, look=True) is load_file(path, look=True)
    first, second = load_file(path), load_file(path)
    assert first is not second
    assert len(executions) == 2


def test_a_plugin_whose_import_takes_long_is_named(write, monkeypatch):
    monkeypatch.setattr("cloudrc.base.outside.patience.SILENT", 0.0)
    source = "import logging, time\n"
    source += "while not logging.getLogger('cloudrc').told: time.sleep(0.001)"
    told = logging.getLogger("cloudrc")
    monkeypatch.setattr(told, "told", [], raising=False)
    monkeypatch.setattr(told, "warning", lambda text, *more: told.told.append(text % more))
    load_file(write(slow=source) / "slow.py")
    assert "slow.py is still being imported" in told.told[0]
