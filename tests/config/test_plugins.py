# SPDX-License-Identifier: Apache-2.0

"""Plug-ins are found by name, entry point or path; an error lists the known names."""

import sys

import pytest

from cloudrc.base import plugins
from cloudrc.config.choice import PlugIn
from cloudrc.config.load import load_experiment
from cloudrc.config.overrides import build_plugin
from tests.config.conftest import refused_line

SOURCE = '''"""Looks ahead by a share of the horizon.

More text.
"""
from cloudrc.cloud.predictors import Predictor


class Share(Predictor):
    def __init__(self, share: float, axes: tuple[bool, bool, bool]) -> None:
        self.share, self.axes = share, axes

    def predict(self, odometry, horizon): ...


def build(share: float = 0.5, axes: tuple[bool, bool, bool] = (True, True, False)) -> Share:
    if share > 1:
        raise ValueError("share: must be at most 1")
    return Share(share, axes)
'''


@pytest.fixture
def share(tmp_path):
    path = tmp_path / "share.py"
    path.write_text(SOURCE)
    return path


def test_a_plug_in_is_loaded_by_path(share):
    assert plugins.describe("predictors", str(share)) == "Looks ahead by a share of the horizon."
    predictor = load_experiment("paper", [f"cloud.predictor={share}"]).cloud.predictor
    assert predictor.model_extra == {"share": 0.5, "axes": [True, True, False]}
    built = build_plugin("predictors", predictor)
    assert (built.share, built.axes) == (0.5, (True, True, False))
    whole = PlugIn.model_validate({"name": str(share), "share": 1})
    assert build_plugin("predictors", whole).share == 1.0


@pytest.mark.parametrize(
    ("setting", "reason"),
    [
        ("share=much", "cloud.predictor.share: 'much': must be a valid number"),
        ("shar=1", "cloud.predictor.shar: unknown key; did you mean share?"),
        ("share=2", "cannot be built: share.py:17: share: must be at most 1"),
    ],
)
def test_parameters_are_checked_against_build(share, setting, reason):
    settings = f"cloud.predictor={share}", f"cloud.predictor.{setting}"
    assert reason in refused_line("paper", *settings)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("import nowhere", "cannot be imported: share.py:1: ModuleNotFoundError: No module named"),
        ("def build():\n    return 1 / 0\n", "cannot be built: share.py:2: ZeroDivisionError"),
        ("def build(share: float): ...", "cloud.predictor.share: is missing"),
        ("def build(): ...", "build() returned NoneType, which has no method predict()"),
    ],
)  # fmt: skip
def test_a_broken_plug_in_is_one_line(share, text, reason):
    share.write_text(text)
    assert reason in refused_line("paper", f"cloud.predictor={share}")
    if "cannot be imported" in reason:
        assert plugins.describe("predictors", str(share)).startswith("(not usable")


@pytest.mark.parametrize("kind", ["predictor", "estimator", "controller"])
def test_a_plug_in_that_lacks_a_method_is_refused_before_the_flight(share, kind):
    lacking, *others = plugins.METHODS[f"{kind}s"]
    lines = [f"    def {name}(self, *given): ..." for name in others]
    share.write_text("\n".join(["class Own:", *lines, "build = Own"]))
    line = refused_line("paper", f"cloud.{kind}={share}")
    assert f"build() returned Own, which has no method {lacking}()" in line


def test_installed_packages_add_plug_ins(share, monkeypatch):
    values = {"as_module": "share", "as_function": "share:build", "last_sample": "share"}
    lines = [f"{name} = {value}" for name, value in values.items()]
    about = share.parent / "mine-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Name: mine\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text("\n".join(["[cloudrc.predictors]", *lines]))
    monkeypatch.syspath_prepend(str(share.parent))
    assert {"as_module", "as_function"} <= set(plugins.names("predictors"))
    assert plugins.names("predictors").count("last_sample") == 1
    assert plugins.load("predictors", "as_module").share == 0.5
    assert load_experiment("paper", ["cloud.predictor=as_function"]).cloud.predictor.name
    # An installed package cannot replace a shipped plug-in.
    assert "share" not in plugins.signature("predictors", "last_sample").parameters
    sys.modules.pop("share", None)


@pytest.mark.parametrize(
    ("settings", "gain_p"),
    [
        (["cloud.controller.gain_p.1=3"], [0.8, 3.0, 1.5]),
        (["cloud.controller=pid", "cloud.controller.gain_p.0=2"], [2.0, 0.8, 1.5]),
    ],
)
def test_an_index_keeps_the_default_of_the_other_entries(settings, gain_p):
    controller = load_experiment("steps", settings).cloud.controller
    assert controller.model_extra["gain_p"] == gain_p


def test_an_index_keeps_the_defaults_of_plug_ins_by_path_and_of_steps(share, tmp_path, monkeypatch):
    monkeypatch.chdir(share.parent)
    (tmp_path / "own.yaml").write_text("steps: {count: 2}")
    settings = ["cloud.predictor=./share.py", "cloud.predictor.axes.2=true", "mission=./own.yaml"]
    experiment = load_experiment("steps", [*settings, "mission.steps.centre_m.0=0.1"])
    assert experiment.cloud.predictor.model_extra["axes"] == [True, True, True]
    assert experiment.mission.steps.centre_m == (0.1, 0.0, 1.2)
