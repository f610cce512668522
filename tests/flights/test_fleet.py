# SPDX-License-Identifier: Apache-2.0

"""Robots of a fleet act on each other through the cell and the shared cloud alone."""

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.flight.experiment import check_mode, robots_of
from cloudrc.flight.fleet import assemble_fleet
from cloudrc.flight.pod.ends import EndSettings, open_end
from cloudrc.results.record.columns import Recording, RecordStore, datagrams
from tests.config.conftest import refused
from tests.conftest import nightly_rows
from tests.flights.conftest import sha256

pytestmark = pytest.mark.usefixtures("shared_files")

SHORT = ("mission.steps.count=1", "mission.steps.period_s=0.5", "criteria.time_limit_s=1")
VARIED = "fleet.vary=[{world.robot: x2, seed: 4}, {link.both.delay_ms: 60, link.both.loss: 0.02}]"
CLOCK = "cloud.clock_offset_s=5"
LATE = ("cloud.compute_ms=8", "cloud.compute_deviation_ms=4", "cloud.cores=1")


def alone(*settings):
    return sha256(load_experiment("steps", (*SHORT, *settings)))


def fly_fleet(name, *settings):
    """Fly a fleet with a shipped experiment; return the recording of each robot."""
    experiment = load_experiment(name, settings)
    robots = robots_of(experiment, name, settings)
    stores = [RecordStore() for _ in robots]
    assemble_fleet(experiment, robots, [store.add for store in stores]).fly()
    return [Recording(records=store) for store in stores]


def in_fleet(*settings):
    """Fly a fleet; return the hash of each robot's records."""
    return [flown.sha256 for flown in fly_fleet("steps", *SHORT, *settings)]


@pytest.mark.parametrize("own", [(), (VARIED,), ("fleet.phase=equal", CLOCK)])
def test_without_contention_each_robot_flies_as_alone(own):
    flown = in_fleet("fleet.robots=3", *own)
    assert flown == [alone("fleet.robots=3", *own, f"fleet.only={k}") for k in range(3)]
    assert len({*flown}) == 3


def test_robot_0_flies_as_without_a_fleet():
    assert in_fleet("fleet.robots=2")[0] == alone() == alone("fleet.robots=1")


def test_a_cell_without_limits_is_no_cell():
    fleet = "fleet.robots=3", VARIED
    assert in_fleet(*fleet, "cell.rate_kbit=1e12") == in_fleet(*fleet)


@pytest.mark.parametrize(
    ("queue", "rate", "packets"),
    [("fifo", 200, 1000), *nightly_rows(("fifo", 150, 20)), ("drr", 150, 20)],
)
def test_one_robot_in_a_cell_is_a_robot_behind_a_bottleneck(queue, rate, packets):
    odd = "link.both.keep_order=true", "link.both.duplicate=0.05", "link.both.corrupt=0.01"
    cell = f"cell.rate_kbit={rate}", f"cell.queue_packets={packets}", f"cell.queue={queue}"
    link = f"link.both.rate_kbit={rate}", f"link.both.queue_packets={packets}"
    assert in_fleet(*odd, *cell) == [alone(*odd, *link)]


@pytest.mark.parametrize("sharing", ["fifo", "ps"])
def test_one_cloud_on_shared_cores_computes_as_alone(sharing):
    flown = in_fleet(CLOCK, *LATE, "cell.rate_kbit=1e12", f"cloud.sharing={sharing}")
    assert flown == [alone(CLOCK, *LATE[:2])]


def test_robots_share_cores_also_if_each_has_its_own_time_to_compute():
    place = "fleet.robots=2", "cloud.place=edge", "cloud.cores=1"
    each = in_fleet(*place, "fleet.vary=[{cloud.compute_ms: 20}]")
    assert each == in_fleet(*place, "cloud.compute_ms=20")


def test_cores_that_robots_share_need_virtual_time(tmp_path):
    settings = "fleet.robots=2", *LATE
    check_mode(load_experiment("steps", settings), "virtual")
    with pytest.raises(BadInputError, match="share them in virtual time only"):
        check_mode(load_experiment("steps", settings), "local")
    config = tmp_path / "config.yaml"
    config.write_text("cloud: {compute_ms: 8, cores: 1}\n")
    here, nowhere = ("127.0.0.1", 0), tmp_path / "nowhere"
    pod = EndSettings(config, nowhere, here, nowhere, nowhere, robot=0)
    with pytest.raises(BadInputError, match="share them in virtual time only"):
        open_end(pod, "world")


@pytest.mark.parametrize(
    ("queue", "sharing"),
    [("newest", "ps"), *nightly_rows(("fifo", "ps"), ("drr", "fifo"), ("priority", "fifo"))],
)
def test_a_fleet_with_contention_flies_twice_alike(queue, sharing):
    traffic = "cell.traffic=[{kind: bulk}, {kind: video, rate_kbit: 300, direction: downlink}]"
    cell = f"cell.queue={queue}", "cell.rate_kbit=3000", "cell.shared=true", "cell.airtime_us=100"
    fleet = "fleet.robots=4", *cell, traffic, *LATE, f"cloud.sharing={sharing}", "fleet.phase=equal"
    flown = in_fleet(*fleet)
    assert flown == in_fleet(*fleet)
    assert len({*flown}) == 4


def test_each_rover_of_a_fleet_drives_by_its_own_scans_through_the_cell():
    goal = (2.0, 0.0)
    way = f"mission.waypoints=[{{position_m: {[*goal]}, tolerance_m: 0.5}}]"
    flown = fly_fleet("gap", way, "fleet.robots=2", "cell.rate_kbit=1000")
    for flight in flown:
        scans, seen = flight["/scan"], flight["/perception"]
        assert len(scans) > 20
        assert np.isin(seen["seen_stamp_ns"], scans["stamp_ns"]).all()
        acted = np.isin(datagrams(seen), datagrams(flight["/command_applied"]))
        assert acted.mean() > 0.8
        steered = (flight["/setpoint_position"]["setpoint"][:, :2] != goal).any(axis=1)
        assert steered.mean() > 0.5
    first, second = (flight["/scan"]["ranges"][:20] for flight in flown)
    assert not np.array_equal(first, second), "each scanner has its own noise"


def test_how_far_robots_fly_on_alone_changes_nothing(monkeypatch):
    fleet = "fleet.robots=3", "cell.rate_kbit=500", "cell.queue=newest", *LATE
    flown = in_fleet(*fleet)
    monkeypatch.setattr("cloudrc.link.model.LinkDirection.shortest_ns", 0)
    assert flown == in_fleet(*fleet)


def test_settings_of_single_robots_come_from_a_file_too(tmp_path):
    table = tmp_path / "robots.csv"
    table.write_text("world.robot;link.both.delay_ms\nx2;20\npelican;60\n")
    settings = f"fleet.vary={table}", "fleet.robots=3"
    robots = robots_of(load_experiment("steps", settings), "steps", settings)
    assert [robot.world.robot for robot in robots] == ["x2", "pelican", "x2"]
    assert [robot.uplink.delay_ms for robot in robots] == [20.0, 60.0, 20.0]
    assert [robot.fleet.only for robot in robots] == [0, 1, 2]


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("link.both.delay_ms\n10,5\n20\n", "robots.csv, line 2: 2 values for 1 columns"),
        ("link.both.delay_ms,world.robot\n10\n20,nano\n", "line 2: 1 values for 2 columns"),
        (
            "world.robot;link.both.delay_ms\nx2;10,5\n",
            "line 2: link.both.delay_ms: '10,5' has a de",
        ),
        ("seed,seed\n1,2\n", "column seed is there twice"),
    ],
)
def test_a_file_of_robots_that_could_be_misread_is_refused(text, says, tmp_path):
    (tmp_path / "robots.csv").write_text(text)
    assert says in refused("steps", f"fleet.vary={tmp_path / 'robots.csv'}")


@pytest.mark.parametrize(
    ("settings", "why"),
    [
        (["fleet.only=3", "fleet.robots=3"], "the robots are 0 to 2"),
        (["fleet.vary=[{cell.rate_kbit: 5}]"], "cell.rate_kbit is the same for all robots"),
        (["fleet.vary=[{link.both.delay: 5}]", "fleet.only=0"], "did you mean delay_ms"),
        (["fleet.vary=none.csv"], "none.csv"),
        (["cell.rate_kbit=5", "link.both.rate_kbit=5"], "the cell is the bottleneck"),
        (["cloud.cores=2"], "cores needs compute_ms above 0"),
    ],
)
def test_a_fleet_that_cannot_fly_is_refused(settings, why):
    assert why in refused("steps", *settings)
