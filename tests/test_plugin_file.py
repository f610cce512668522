"""Modules beside a plug-in: its import statements find them, and nobody else does."""

import logging
import pickle
import statistics
import sys
from pathlib import Path
from textwrap import dedent

import pytest

from cloudrc.errors import BadInputError
from cloudrc.plugin_file import PREFIX, load_file, sources
from cloudrc.plugins import find


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
    "import helper as other\nvalue = other.value": "another name",
    "from helper import value": "a name of it",
    "from helper import *": "all its names",
    "from .helper import value": "a relative import",
    "from . import helper\nvalue = helper.value": "a module of the folder",
    "import package.inner\nvalue = package.inner.value": "a module of a package",
    "import package.inner as other\nvalue = other.value": "a module of a package by another name",
    "from package import inner\nvalue = inner.value": "a module from a package",
    "from package.inner import value": "a name of a package's module",
    "from package import value": "a name of a package",
    "from package.deep import value": "a relative import in a package",
    "from plain.inner import value": "a folder that is no package",
    "from chain import value": "a module that imports another one",
    "def late():\n    import helper\n    return helper.value\nvalue = late()": "a late import",
    "try:\n    import nowhere\nexcept ImportError:\n    from helper import value": "a missing one",
}


@pytest.mark.parametrize("text", IMPORTS, ids=IMPORTS.values())
def test_every_form_of_import_finds_what_is_beside(write, text):
    folder = write(
        helper="value = 3",
        package__inner="value = 3",
        package__deep="from ..helper import value",
        plain__inner="value = 3",
        chain="from helper import value",
        mine=text,
    )
    (folder / "package" / "__init__.py").write_text("from package.inner import value")
    before = [*sys.path]
    assert load_file(folder / "mine.py").value == 3
    assert sys.path == before
    assert not {"helper", "package", "plain", "chain"} & set(sys.modules)
    assert [*folder.rglob("__pycache__")] == []


def test_helpers_of_the_same_name_do_not_mix(write):
    source = "import helper\ndef late():\n    from helper import value\n    return value\n"
    folder = write(a__mine=source, a__helper="value = 1", b__mine=source, b__helper="value = 2")
    first, second = (load_file(folder / name / "mine.py") for name in "ab")
    assert (first.helper.value, second.helper.value) == (1, 2)
    assert (first.late(), second.late(), first.late()) == (1, 2, 1)


def test_a_changed_helper_counts_at_the_next_load(write):
    folder = write(mine="from helper import value", helper="value = 1")
    assert load_file(folder / "mine.py").value == 1
    write(helper="value = 2")
    assert load_file(folder / "mine.py").value == 2


def test_a_module_named_like_one_of_python_is_seen_by_the_plug_in_only(write):
    folder = write(
        mine="import statistics, wave\nvalue = statistics.value, wave.value",
        statistics="import random\nvalue = 3, random.__name__",  # it uses Python's own
        wave="from statistics import value",
    )
    assert load_file(folder / "mine.py").value == ((3, "random"),) * 2
    assert sys.modules["statistics"] is statistics
    assert statistics.median([1, 2, 3]) == 2


def test_a_plug_in_named_like_a_module_of_python_can_import_that(write):
    folder = write(statistics="from statistics import median\nvalue = median([3])")
    assert load_file(folder / "statistics.py").value == 3


def test_a_plug_in_in_the_folder_of_the_sources_uses_cloudrc_itself(write):
    folder = write(mine="from cloudrc.messages import ZERO", cloudrc__messages="ZERO = 3")
    (folder / "cloudrc" / "__init__.py").touch()
    assert load_file(folder / "mine.py").ZERO == (0.0, 0.0, 0.0)
    assert sources(folder / "mine.py") == [folder / "mine.py"]


def test_a_folder_without_init_does_not_hide_an_installed_package(write):
    folder = write(mine="import numpy\nvalue = numpy.zeros(3)", numpy__other="")
    assert len(load_file(folder / "mine.py").value) == 3


def test_a_dataclass_of_a_helper_knows_its_module(write):
    helper = (
        "from __future__ import annotations\nfrom dataclasses import dataclass\n"
        "from typing import ClassVar\n@dataclass\nclass Gain:\n    u: ClassVar[str]\n    p: float\n"
    )
    folder = write(mine="from helper import Gain\nvalue = Gain(3).p", helper=helper)
    assert load_file(folder / "mine.py").value == 3


@pytest.mark.parametrize(
    ("helper", "said"),
    [
        ("1 / 0", "helper.py:1: ZeroDivisionError: division by zero"),
        ("import sys; sys.exit(0)", "helper.py:1: SystemExit: 0"),
        ("def x(:", r"SyntaxError: .*helper.py, line 1"),
        (
            "\n\ngains = {}\ndef get():\n    return gains['tau']\nget()",
            "helper.py:5: KeyError: 'tau'",
        ),
        ("from mine import build", "helper.py:1: ImportError: "),
    ],
)
def test_a_broken_helper_is_one_error_of_the_plug_in(write, helper, said):
    folder = write(mine="from helper import value", helper=helper)
    with pytest.raises(BadInputError, match=rf"mine.py' cannot be imported: {said}"):
        find("predictors", str(folder / "mine.py"))


def test_a_file_in_another_encoding_says_how_to_save_it(tmp_path):
    path = tmp_path / "mine.py"
    for encoding in ("utf-16", "utf-16-be"):
        path.write_bytes("\ufeff".encode(encoding)[-2:] + "value = 1".encode(encoding)[-18:])
        with pytest.raises(BadInputError, match="is saved as UTF-16; save it as UTF-8"):
            find("predictors", str(path))


@pytest.mark.parametrize(
    ("source", "line"),
    [
        ("x = 1\n\ny = 'fähig'\n", 3),
        ("x = 1\r\n\r\n# fähig\r\nx = (", 3),
        ("# fähig\nx = 1\n", 1),
        ('"""Text.\n\nfähig\n"""\n', 3),
    ],
)
def test_a_file_saved_as_latin_1_names_its_line_and_how_to_save_it(write, source, line):
    folder = write(mine="import helper", helper="")
    said = rf"helper.py:{line}: is not saved as UTF-8 \(byte 0xe4\); save it as UTF-8$"
    (folder / "helper.py").write_bytes(source.encode("latin-1"))
    with pytest.raises(BadInputError, match=f"mine.py' cannot be imported: {said}"):
        find("predictors", str(folder / "mine.py"))


def test_a_file_that_declares_its_encoding_may_have_it(write):
    text = "# -*- coding: latin-1 -*-\nvalue = 'fähig'\n"
    folder = write(mine="from helper import value", helper="")
    (folder / "helper.py").write_bytes(text.encode("latin-1"))
    assert load_file(folder / "mine.py").value == "fähig"
    (folder / "helper.py").write_text(text.replace("latin-1", "utf-8"), "utf-8-sig")
    assert load_file(folder / "mine.py").value == "fähig"


@pytest.mark.parametrize("near", ["Mine.py", "mine.py.txt", "mine.ipynb"])
def test_a_missing_file_names_the_one_that_may_be_meant(tmp_path, near):
    (tmp_path / near).write_text("value = 1")
    with pytest.raises(BadInputError, match=rf"no such file; did you mean {near}\?"):
        find("predictors", str(tmp_path / "mine.py"))
    with pytest.raises(BadInputError, match=r"there is no such file$"):
        find("predictors", str(tmp_path / "nowhere" / "mine.py"))


def names(files, folder):
    return {str(Path(each).relative_to(folder)) for each in files}


def test_the_sources_of_a_plug_in_are_all_files_that_it_imports(write):
    folder = write(
        mine="import helper\ndef late():\n    from package import deep\n    import numpy, os",
        helper="from .other import value",
        other="import mine",  # a circle
        package__deep="from ..third import value",
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


def test_a_plugin_or_a_module_beside_it_that_changes_after_a_look_is_executed_anew(write):
    folder = write(plugin="from helper import value", helper="value = 1")
    load_file(folder / "plugin.py", look=True)
    write(helper="value = 12")
    assert load_file(folder / "plugin.py").value == 12


@pytest.mark.parametrize("name", ["plugin", "my-plugin", "my.plugin"])
def test_a_process_that_a_plugin_starts_can_import_it_by_its_name(write, name):
    """A ProcessPoolExecutor sends functions by the names of their modules."""
    folder = write(
        plugin="from helper import value\ndef f(x): return x + value", helper="value = 2"
    )
    path = (folder / "plugin.py").rename(folder / f"{name}.py")
    sent = pickle.dumps(load_file(path).f)
    for known in [each for each in sys.modules if each.startswith(PREFIX)]:
        del sys.modules[known]
    assert pickle.loads(sent)(1) == 3  # noqa: S301


def test_a_plugin_whose_import_takes_long_is_named(write, monkeypatch):
    monkeypatch.setattr("cloudrc.patience.SILENT", 0.0)
    source = "import logging, time\n"
    source += "while not logging.getLogger('cloudrc').told: time.sleep(0.001)"
    told = logging.getLogger("cloudrc")
    monkeypatch.setattr(told, "told", [], raising=False)
    monkeypatch.setattr(told, "warning", lambda text, *more: told.told.append(text % more))
    load_file(write(slow=source) / "slow.py")
    assert "slow.py is still being imported" in told.told[0]
