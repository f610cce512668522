"""Plug-ins are found by name, entry point or path; an unknown one lists the known ones."""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest

from cloudrc import plugins
from cloudrc.config.load import load_experiment
from cloudrc.config.overrides import build_plugin
from cloudrc.config.schema import PlugIn
from cloudrc.errors import BadInputError

SOURCE = '''"""Looks ahead by a share of the horizon.

More text.
"""
from __future__ import annotations

from cloudrc.cloud.predictors import Predictor


class Share(Predictor):
    def __init__(self, share: float, axes: tuple[bool, bool, bool]) -> None:
        self.share, self.axes = share, axes


def build(share: float = 0.5, axes: tuple[bool, bool, bool] = (True, True, False)) -> Share:
    if share > 1:
        raise ValueError("share: must be at most 1")
    return Share(share, axes)
'''


@pytest.fixture
def share(tmp_path: Path) -> Path:
    path = tmp_path / "share.py"
    path.write_text(SOURCE)
    return path


def refused(*settings: str) -> str:
    with pytest.raises(BadInputError) as caught:
        load_experiment("paper", settings)
    return str(caught.value)


@pytest.mark.parametrize("kind", ["estimators", "predictors", "controllers"])
def test_every_kind_has_plug_ins_with_a_line_each(kind: str) -> None:
    names = plugins.names(kind)
    assert names == sorted(names)
    assert names
    for name in names:
        assert not name.startswith("_")
        assert plugins.describe(kind, name)
        assert not plugins.describe(kind, name).startswith("(not usable")


def test_names_lists_the_shipped_plug_ins() -> None:
    assert {"last_sample", "constant_velocity"} <= set(plugins.names("predictors"))
    assert "pid" in plugins.names("controllers")


def test_an_unknown_name_lists_known_names_and_the_nearest() -> None:
    with pytest.raises(BadInputError) as caught:
        plugins.load("predictors", "last_sampel")
    assert str(caught.value).startswith("no predictor named 'last_sampel'; available: ")
    assert str(caught.value).endswith("; did you mean last_sample?")
    with pytest.raises(BadInputError, match="no kind of plug-in named 'pilots'"):
        plugins.names("pilots")


@pytest.mark.parametrize("name", ["_rotation", "__init__", "os", "..", ""])
def test_helpers_and_other_modules_are_refused(name: str) -> None:
    with pytest.raises(BadInputError):
        plugins.load("predictors", name)


def test_a_plug_in_is_loaded_by_path(share: Path) -> None:
    assert plugins.load("predictors", str(share), share=0.25).share == 0.25
    assert plugins.describe("predictors", str(share)) == "Looks ahead by a share of the horizon."
    parameters = plugins.signature("predictors", str(share)).parameters
    assert parameters["share"].annotation is float  # evaluated: config checks values against it


def test_an_experiment_has_all_parameters(share: Path) -> None:
    predictor = load_experiment("paper", [f"cloud.predictor={share}"]).cloud.predictor
    assert predictor.model_extra == {"share": 0.5, "axes": [True, True, False]}
    built = build_plugin("predictors", predictor)
    assert (built.share, built.axes) == (0.5, (True, True, False))


def test_parameters_are_checked_against_build(share: Path) -> None:
    choice = f"cloud.predictor={share}"
    cases = {
        "cloud.predictor.share=much": "cloud.predictor.share: 'much': must be a number",
        "cloud.predictor.shar=1": "cloud.predictor.shar: unknown key; did you mean share?",
        "cloud.predictor.axes=[true]": "cloud.predictor.axes.1: is missing",
        "cloud.predictor.share=.inf": "cloud.predictor.share: inf: must be finite",
        "cloud.predictor.share=2": "cannot be built: share: must be at most 1",
    }
    for setting, reason in cases.items():
        assert reason in refused(choice, setting)


def test_an_integer_is_accepted_as_a_number(share: Path) -> None:
    choice = PlugIn.model_validate({"name": str(share), "share": 1})
    assert build_plugin("predictors", choice).share == 1.0


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("import nowhere", "cannot be imported: ModuleNotFoundError: No module named 'nowhere'"),
        ("def build(:", "cannot be imported: SyntaxError"),
        ("x = 1", "has no function build()"),
        ("def build(a: Nowhere = 1): ...\n", "cannot be imported: NameError"),
        ("from __future__ import annotations\ndef build(a: Nowhere = 1): ...\n",
         "annotations of build() cannot be read: name 'Nowhere' is not defined"),
        ("def build():\n    return 1 / 0\n", "cannot be built: ZeroDivisionError"),
    ],
)  # fmt: skip
def test_a_broken_plug_in_is_one_line(share: Path, text: str, reason: str) -> None:
    share.write_text(text)
    found = refused(f"cloud.predictor={share}")
    assert reason in found
    assert "\n" not in found
    if "built" not in reason and "annotations" not in reason:
        assert (
            plugins.describe("predictors", str(share)).startswith("(not usable") or text == "x = 1"
        )


def test_a_missing_plug_in_file_is_refused(tmp_path: Path) -> None:
    assert "there is no such file" in refused(f"cloud.predictor={tmp_path}/no.py")
    (tmp_path / "notes.txt").write_text("no")
    assert "name it *.py" in refused(f"cloud.predictor={tmp_path}/notes.txt")


def test_installed_packages_add_plug_ins(share: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    entries = {
        "as_module": EntryPoint("as_module", "share", "cloudrc.predictors"),
        "as_function": EntryPoint("as_function", "share:build", "cloudrc.predictors"),
        "last_sample": EntryPoint("last_sample", "share", "cloudrc.predictors"),
    }
    monkeypatch.syspath_prepend(str(share.parent))
    monkeypatch.setattr(
        plugins,
        "entry_points",
        lambda group: tuple(entries.values()) if group == "cloudrc.predictors" else (),
    )
    assert {"as_module", "as_function"} <= set(plugins.names("predictors"))
    assert plugins.names("predictors").count("last_sample") == 1
    assert plugins.load("predictors", "as_module").share == 0.5
    assert load_experiment("paper", ["cloud.predictor=as_function"]).cloud.predictor.name
    # An installed package cannot replace a shipped plug-in.
    assert "share" not in plugins.signature("predictors", "last_sample").parameters
    sys.modules.pop("share", None)
