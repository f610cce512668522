# SPDX-License-Identifier: Apache-2.0

"""Experiments are resolved, values override each other in order, and a dump loads again."""

import hashlib
import shutil
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside import document
from cloudrc.base.outside.document import parse_value
from cloudrc.config import shipped
from cloudrc.config.load import load_experiment, read_experiment
from cloudrc.config.profile import load_profile
from cloudrc.config.resolved import dump, fingerprint
from cloudrc.config.robot import find_robot
from cloudrc.link.traces import link_profile
from cloudrc.physics.geometry.scene import SCENES, load_scene
from tests.config.conftest import refused_line

PROFILES = shipped.names("profile")


def again(experiment, folder, *settings):
    path = folder / "config.yaml"
    path.write_text(dump(experiment), "utf-8")
    return load_experiment(path, settings)


@pytest.mark.parametrize(
    ("experiment", "profile"),
    [
        *(("paper", name) for name in PROFILES),
        *((name, "lossy") for name in ("paper-verbatim", "steps", "hover")),
    ],
)
@pytest.mark.usefixtures("files_are_read_once")
def test_a_dump_loads_to_the_same(experiment, profile, tmp_path):
    loaded = load_experiment(experiment, [f"link.profile={profile}"])
    assert again(loaded, tmp_path) == loaded
    assert loaded.link.profile == profile
    assert loaded.uplink == load_profile(profile).uplink
    assert loaded.downlink == load_profile(profile).downlink
    # A setting on a resolved file replaces the values and limits that follow from the old value.
    for setting in ("link.profile=paper-p3", "cloud.plan_s=0.4", "guard.command_age_max_ms=300"):
        sets = [setting, "cloud.predictor=kalman"]
        before = [f"link.profile={profile}"] * (not setting.startswith("link."))
        changed = again(loaded, tmp_path, *sets)
        assert changed == load_experiment(experiment, [*before, *sets])


def test_paper_is_the_published_scheme():
    paper = load_experiment("paper")
    assert (paper.link.profile, paper.tunnel.order) == ("paper-p2", "newest")
    assert (paper.uplink.delay_ms, paper.uplink.jitter_ms) == (45, 25)
    assert paper.cloud.estimator.name == "running_mean"
    assert paper.cloud.predictor.name == "constant_velocity"
    assert paper.cloud.controller.model_extra["gain_p"] == [0.8, 0.8, 1.5]
    assert len(paper.mission.waypoints) == 7
    assert paper.mission.waypoints[-1].position_m == (8.235, -6.422, 0.7)
    assert (paper.guard.command_age_max_ms, paper.mission.touched) == (250, "board")
    verbatim = load_experiment("paper-verbatim")
    assert (verbatim.tunnel.order, verbatim.guard.command_age_max_ms) == ("arrival", 400)


@pytest.mark.parametrize(
    ("experiment", "settings", "age", "cap"),
    [
        ("paper", (), 250, 6.0),
        ("paper", ("link.profile=satellite",), 800, 4.823043),
        ("paper", ("link.profile=satellite", "guard.speed_max_mps=2"), 800, 2.0),
        ("paper-verbatim", ("link.profile=satellite",), 400, 5.645805),
    ],
)
def test_the_age_limit_of_file_or_profile_sets_the_speed_cap(experiment, settings, age, cap):
    # v (T + 0.2) + v^2 / 6 = 8.7 m, solved by hand for T = 0.25, 0.4 and 0.8 s.
    guard = load_experiment(experiment, settings).guard
    assert guard.command_age_max_ms == age
    assert guard.speed_max_mps == pytest.approx(cap, abs=1e-5)


ELSEWHERE = ["criteria.contact=false", "mission.waypoints=[{position_m: [0.5, 0, 0.7]}]"]


@pytest.mark.parametrize(
    ("name", "settings", "touch"),
    [
        ("paper", [], ("board", 0.25)),
        ("paper", ELSEWHERE, None),
        ("hover", ["world.scene=pillars", "mission.touch.body=pillar_1"], ("pillar_1", 0.25)),
    ],
)
def test_a_mission_says_what_the_robot_touches(name, settings, touch):
    found = load_experiment(name, settings).mission.touch
    assert (found and (found.body, found.speed_max_mps)) == touch


def test_single_values_override_the_profile(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("link: {profile: lossy, uplink: {delay_ms: 120}}\n")
    experiment = load_experiment(path)
    assert experiment.name == "mine"
    assert experiment.uplink == load_profile("lossy").uplink.model_copy(update={"delay_ms": 120.0})
    assert experiment.downlink == load_profile("lossy").downlink
    other = load_experiment(path, ["link.profile=paper-p1"])
    assert (other.uplink.delay_ms, other.uplink.jitter_ms) == (120, 10)


@pytest.mark.parametrize("text", ["exp #2", "exp: 2", "*x", "12:30"])
def test_a_value_is_the_whole_rest_of_its_argument(text):
    assert load_experiment("hover", [f"name={text}"]).name == text


def test_a_value_may_be_a_number_a_list_or_quoted():
    values = {"1e-3": 0.001, "true": True, "": None, "[1, 'a #']": [1, "a #"], '"5"': "5"}
    assert {text: parse_value(text, "x") for text in values} == values
    assert parse_value("a: 1\nb: 2", "x") == {"a": 1, "b": 2}


@pytest.mark.parametrize(
    ("columns", "setting", "key"),
    [
        ("delay_ms", "link.uplink.delay_ms=20", "link.uplink.delay_ms: 20"),
        ("delay_ms", "link.downlink.delay_ms=20", ""),
        ("delay_ms,loss", "link.uplink.loss=0.1", "link.uplink.loss: 0.1"),
    ],
)
def test_a_setting_that_a_trace_replaces_is_refused(tmp_path, columns, setting, key):
    """Otherwise all flights of a sweep over this key would be equal, without a word."""
    trace = tmp_path / "trace.csv"
    trace.write_text(f"time_s,{columns}\n0{',1' * len(columns.split(','))}\n")
    load_experiment("hover", ["link.profile=ideal", f"link.uplink={{trace: {trace}}}"])
    settings = [f"link.uplink.trace={trace}", setting]
    if not key:
        load_experiment("hover", settings)
        return
    line = refused_line("hover", *settings)
    assert key in line
    assert "has no effect, because link.uplink.trace replaces it; set that to null" in line


def test_paths_start_at_the_file_that_names_them(tmp_path, monkeypatch):
    links = tmp_path / "links"
    links.mkdir()
    for path, text in {
        "links/trace.csv": "time_s,delay_ms\n0,20\n1,40\n",
        "links/traced.yaml": "uplink: {trace: trace.csv}\n"
        "downlink: {distribution: table, table: trace.csv, delay_ms: 30, jitter_ms: 10}\n",
        "there.yaml": "waypoints: [{position_m: [0.5, 0, 0.7]}]\n",
        "still.py": "from cloudrc.cloud.predictors.last_sample import build\n",
        "mine.xml": (Path(shipped.FOLDERS["scene"]) / "pipes.xml").read_text(),
        "mine.yaml": "world: {robot: ./mine.xml, scene: mine.xml}\nmission: ./there.yaml\n"
        "link: {profile: links/traced.yaml}\ncloud: {predictor: still.py}\n"
        "report: {metrics: [a.py, duration]}\n",
    }.items():
        (tmp_path / path).write_text(text)
    monkeypatch.chdir(links)
    experiment = load_experiment(tmp_path / "mine.yaml", ["report.metrics.2=./b.py"])
    assert experiment.uplink.trace == experiment.downlink.table == str(links / "trace.csv")
    assert link_profile(experiment.downlink).quantiles == pytest.approx((-1.0, 1.0))
    assert experiment.link.profile == str(links / "traced.yaml")
    assert experiment.cloud.predictor.name == str(tmp_path / "still.py")
    assert experiment.mission.waypoints[0].position_m == (0.5, 0, 0.7)
    assert experiment.world.robot == experiment.world.scene == str(tmp_path / "mine.xml")
    assert load_scene(experiment.world.scene).tubes == load_scene("pipes").tubes
    assert experiment.report.metrics == (str(tmp_path / "a.py"), "duration", str(links / "b.py"))
    assert again(experiment, links) == experiment
    texts = ["link.downlink.trace=trace.csv", "mission=../there.yaml"]
    from_here = load_experiment("hover", texts)
    assert from_here.downlink.trace == str(links / "trace.csv")
    whole = load_experiment("hover", ["link={uplink: {trace: trace.csv}}"])
    assert whole.uplink.trace == str(links / "trace.csv")
    assert from_here.mission == experiment.mission


# PyYAML converts Unicode's other line ends to line feeds; NUL is refused.
ODD = "\0\x85\u2028\u2029"
texts = st.text(st.characters(exclude_categories=["Cs"], exclude_characters=ODD))
plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | texts,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(texts, inner, max_size=3),
    max_leaves=8,
)


@settings(max_examples=40, deadline=None)
@given(plain)
def test_written_yaml_parses_to_equal_values(value):
    assert document.parse_yaml(document.write_yaml(value), "text")[0] == value


def test_a_configuration_has_the_hash_of_its_file(tmp_path):
    experiment = load_experiment("paper", ["link.profile=satellite", "seed=7"])
    path = tmp_path / "config.yaml"
    path.write_text(dump(experiment), "utf-8")
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    assert fingerprint(experiment) == expected
    assert fingerprint(load_experiment(path)) == expected
    assert fingerprint(read_experiment(str(path))) == expected
    assert fingerprint(load_experiment(path, ["guard.speed_max_mps=1.4"])) != expected
    # The chart's experiment has only given parameters; only cloud could complete it.
    path.write_text("seed: 5\n")
    assert fingerprint(read_experiment(str(path))) != fingerprint(load_experiment(path))


def test_a_flight_that_is_over_needs_no_files_and_keeps_its_limits(tmp_path):
    files = [tmp_path / name for name in ("robot", "mine.xml", "trace.csv", "path.csv")]
    robot, scene, trace, path = files
    shutil.copytree(find_robot("rover").model.parent, robot)
    shutil.copy(SCENES / "pillars.xml", scene)
    trace.write_text("time_s,delay_ms\n0,30\n5,40\n")
    path.write_text("time_s,x_m,y_m\n0,0,0\n5,0.2,0\n")
    keys = ("world.robot", "world.scene", "link.uplink.trace", "mission.setpoints")
    settings = [f"{key}={file}" for key, file in zip(keys, files, strict=True)]
    flown = load_experiment("pillars", settings)
    (tmp_path / "config.yaml").write_text(dump(flown))
    text = (robot / "robot.yaml").read_text()
    (robot / "robot.yaml").write_text(text.replace("speed_max_mps: ", "speed_max_mps: 0."))
    assert read_experiment(tmp_path / "config.yaml", flown=True) == flown
    for file in files:
        file.rename(file.with_name(f"{file.name}.away"))
    assert read_experiment(tmp_path / "config.yaml", flown=True) == flown
    with pytest.raises(BadInputError, match="3 problems"):
        read_experiment(tmp_path / "config.yaml")
