# SPDX-License-Identifier: Apache-2.0

"""A grid becomes points with keys; a problem is refused with its file and line.

A file of flights gives the same flights in a pod that has none of the user's files.
"""

import re

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.flight.trials.plan import pack, read_plan, unpack
from cloudrc.physics.geometry.scene import SCENES
from tests.support.pages import blocks
from tests.support.sweeps import SHORT


def test_every_point_is_flown_with_every_seed(write_sweep):
    sweep = read_plan(write_sweep(seeds=[7, 3]))
    assert (len(sweep.points), len(sweep.flights), sweep.draft.seeds) == (4, 8, [7, 3])
    flights = list(sweep.flights.values())
    assert [(*each.point.values(), each.seed) for each in flights[:3]] == [
        ("last_sample", 40, 7), ("last_sample", 40, 3), ("last_sample", 0, 7)
    ]  # fmt: skip
    last = flights[-1].experiment
    assert (last.seed, last.cloud.predictor.name) == (3, "constant_velocity")
    assert last.uplink.delay_ms == last.downlink.delay_ms == 0 < last.uplink.jitter_ms
    assert read_plan(write_sweep(seeds=2)).draft.seeds == [1, 2]


def test_points_that_differ_in_the_network_share_their_flights_without_one(write_sweep):
    links = {"here": {"link.both.delay_ms": 0}, "far": {"link.both.delay_ms": 40}}
    grid = {"cloud.predictor": ["last_sample", "kalman"], "link": links}
    short = {**SHORT, "link.profile": "ideal"}
    sweep = read_plan(write_sweep(grid, seeds=2, cost=True, set=short))
    assert len(sweep.baselines) == len(sweep.flights) == 8
    grid["link"] = {"near": {"link.both.delay_ms": 20}, "far": {"link.both.delay_ms": 40}}
    path = write_sweep(grid, seeds=2, cost=True, set={**short, "guard.command_age_max_ms": 900})
    sweep = read_plan(path)
    counts = len(sweep.baselines), len({*sweep.baselines.values()}), len(sweep.flights)
    assert counts == (8, 4, 12)
    bare = sweep.flights[sweep.baselines[[*sweep.baselines][-1]]].experiment
    assert (bare.seed, bare.cloud.predictor.name, bare.link.profile) == (2, "kalman", "ideal")
    assert (bare.uplink.delay_ms, bare.guard.command_age_max_ms) == (0.0, 900.0)


def test_where_the_setpoint_waits_a_flight_is_compared_with_its_path_over_an_ideal_link(
    write_sweep, tmp_path
):
    """The missions with a carrot beside it keep J/J0."""
    grid = {"mission.carrot": [None, {"speed_mps": 0.5}]}
    grow = {"experiment": "paper", "set": {}, "seeds": 2}
    plain = read_plan(write_sweep(grid, **grow))
    sweep = read_plan(write_sweep(grid, cost=True, **grow))
    flights = [*sweep.flights.values()]
    assert [each.is_beside_ideal for each in flights] == [True] * 2 + [False] * 4
    assert list(sweep.baselines.items()) == [(flights[n].key, flights[n + 2].key) for n in (2, 3)]
    assert sweep.units.keys() - plain.units.keys() == {"J/J0", "off_ideal_path", "T/T0"}
    assert [key in plain.flights for key in sweep.flights] == [False] * 2 + [True] * 2 + [False] * 2
    (tmp_path / "flights").write_bytes(pack(flights))
    assert unpack(tmp_path / "flights") == flights


def test_settings_that_change_the_guards_speed_cap_are_named(write_sweep):
    grid = {"guard.command_age_max_ms": [250, 1500], "cloud.predictor": ["kalman", "last_sample"]}
    caps = read_plan(write_sweep(grid)).speed_caps
    assert caps.endswith("from 6 m/s to 3.74 m/s (guard.command_age_max_ms=1500)")
    assert read_plan(write_sweep()).speed_caps == ""


def test_an_axis_may_have_named_settings(write_sweep):
    grid = {"gains": {"low": {"cloud.controller.gain_p": [1, 1, 1]}, "default": {}}}
    sweep = read_plan(write_sweep(grid))
    assert [each.point for each in sweep.flights.values()] == [
        {"gains": "low"},
        {"gains": "default"},
    ]
    assert sweep.points[0].cloud.controller.model_extra["gain_p"] == [1, 1, 1]
    assert sweep.points[1].cloud.controller.model_extra["gain_p"] != [1, 1, 1]
    assert sweep.axes == {"gains": ["low", "default"]}


def test_equal_flights_have_equal_keys_however_they_are_written(write_sweep):
    keys = list(read_plan(write_sweep({"link.both.delay_ms": [40, 0]}, seeds=2)).flights)
    assert len({*keys}) == 4
    assert all(len(key) == 16 for key in keys)
    delays = {"far": {"link.uplink.delay_ms": 40, "link.downlink.delay_ms": 40.0}}
    assert list(read_plan(write_sweep({"delay": delays}, seeds=2)).flights) == keys[:2]


def keys_with(path, file, *texts):
    """Return the keys of a sweep with each text in a file."""
    found = []
    for text in texts:
        file.write_text(text)
        found.append([*read_plan(path).flights])
    return found


@pytest.mark.parametrize("key", ["robot", "scene"])
def test_a_key_depends_on_what_a_model_includes(write_sweep, tmp_path, key):
    """A resumed sweep had two scenes in one table."""
    shipped = {"robot": "robots/pelican/robot.xml", "scene": "world/scenes/empty.xml"}[key]
    text = (SCENES.parents[1] / shipped).read_text()
    including = text.replace("<worldbody>", '<worldbody><include file="b.xml"/>')
    (tmp_path / "mine.xml").write_text(including)
    path = write_sweep({f"world.{key}": ["./mine.xml"]})
    part = '<mujoco><site name="one" pos="0 9 5" size=".1"/></mujoco>'
    other = part.replace(".1", ".2")
    before, again, after = keys_with(path, tmp_path / "b.xml", part, part, other)
    assert before == again != after


@pytest.mark.parametrize("named", ["in the source", "in a parameter"])
def test_a_key_depends_on_the_data_of_a_plug_in(write_sweep, tmp_path, named):
    base = "from pathlib import Path\nfrom cloudrc.cloud.predictors.last_sample import LastSample\n"
    file = '"gains.json"' if named == "in the source" else "None"
    build = f"def build(file: Path | None = {file}):\n    return LastSample()\n"
    (tmp_path / "mine.py").write_text(base + build)
    settings = {} if named == "in the source" else {"cloud.predictor.file": "gains.json"}
    path = write_sweep({"cloud.predictor": ["./mine.py"]}, set={**SHORT, **settings})
    before, again, after = keys_with(path, tmp_path / "gains.json", "1", "1", "2")
    assert before == again != after


def test_relative_paths_start_at_the_file(write_sweep, tmp_path, monkeypatch):
    source = "from cloudrc.cloud.predictors.last_sample import build\n"
    (tmp_path / "mine.py").write_text(source)
    (tmp_path / "own.yaml").write_text("{world: {scene: empty}, mission: steps}\n")
    monkeypatch.chdir("/")
    path = write_sweep({"cloud.predictor": ["./mine.py"]}, experiment="./own.yaml", set={})
    (point,) = read_plan(path).points
    assert point.cloud.predictor.name == str(tmp_path / "mine.py")
    assert read_plan(path).draft.file["folder"] == str(tmp_path)


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"grid": {"link.both.delayms": [1]}}, "link.uplink.delayms: unknown key; did you mean"),
        ({"grid": {"world.plant.payload_kg": [0, 9]}}, "world.plant: the thrust-to-weight ratio"),
        ({"set": {"seed": 1}}, "seed: each flight has its own seed"),
        ({"seeds": 0}, "seeds: must have at least 1"),
        ({"seeds": [3, -1]}, "seeds.1: -1: must be >= 0"),
        ({"seeds": [3, 3]}, "seeds: repeats a seed"),
    ],
)
def test_a_problem_is_refused_at_its_place(write_sweep, keys, reason):
    path = write_sweep(**{"set": SHORT, **keys})
    with pytest.raises(BadInputError) as caught:
        read_plan(path)
    assert reason in str(caught.value)
    number = re.search(rf"{re.escape(str(path))}:(\d+)", str(caught.value))[1]
    key = list(keys.get("grid", keys))[-1]
    assert key in path.read_text().splitlines()[int(number) - 1]


def test_the_file_of_the_page_is_a_sweep(tmp_path):
    (tmp_path / "grid.yaml").write_text(blocks("sweeps", "yaml")[0])
    sweep = read_plan(tmp_path / "grid.yaml")
    assert (len(sweep.points), len(sweep.flights)) == (12, 240)


@pytest.fixture
def flights(tmp_path):
    (tmp_path / "mine.yaml").write_text("mission: steps\nworld: {scene: empty}\n")
    text = "experiment: ./mine.yaml\ngrid: {cloud.predictor: [last_sample, constant_velocity]}\n"
    (tmp_path / "sweep.yaml").write_text(text + "seeds: [3, 1]\n")
    return [*read_plan(tmp_path / "sweep.yaml").flights.values()]


@pytest.mark.parametrize("some", [slice(None), slice(1, 3)])
def test_the_flights_are_the_same_in_a_pod(flights, tmp_path, some):
    (tmp_path / "flights").write_bytes(pack(flights[some]))
    (tmp_path / "mine.yaml").unlink()
    assert unpack(tmp_path / "flights") == flights[some]
