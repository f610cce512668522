# SPDX-License-Identifier: Apache-2.0

"""The stages of a command add up to its age; the others are counted by where they ended."""

import itertools

import numpy as np
import pytest

from cloudrc.results.metrics.budget import NO_CLOCK, ONE_END, budget_of
from cloudrc.results.metrics.measure import SHIPPED
from cloudrc.results.metrics.perception import acted
from cloudrc.results.timeline.loops import of_flight
from cloudrc.results.timeline.read import read_flight
from cloudrc.results.timeline.text import as_text
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import Arrival, GuardChange
from tests.results.timeline.conftest import CONSTANT, MS, SETTINGS, flight_of, records, write


def average_age(flight):
    """Average the age over the time with a command in use, in whole nanoseconds."""
    applied = flight.during("/command_applied")
    guard = flight.recording["/guard"]
    edges = sorted({*applied["stamp_ns"], *guard["stamp_ns"], flight.end_ns})
    total = time = 0
    for begin, end in itertools.pairwise(edges):
        used = applied["stamp_ns"].searchsorted(begin, "right") - 1
        state = guard["state"][guard["stamp_ns"].searchsorted(begin, "right") - 1]
        if used >= 0 and end <= flight.end_ns and state == GuardState.TRACK:
            age, lasts = int(begin - applied["basis_stamp_ns"][used]), int(end - begin)
            total, time = total + lasts * (2 * age + lasts), time + 2 * lasts
    return total / time * 1e-9


@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_stages_add_up_to_the_age_of_each_command(tmp_path, settings):
    flight = flight_of(tmp_path, *settings)
    budget, applied = budget_of(flight), flight.during("/command_applied")
    lengths = np.diff(budget.followed, axis=0)
    assert lengths.min() >= 0
    ages = applied["stamp_ns"] - applied["basis_stamp_ns"]
    assert (lengths.sum(axis=0) == ages).all()
    assert len(ages) > 100
    document, measured = budget.document, SHIPPED["age_at_actuator_mean"].measure(flight)
    assert document["time_average"] == measured
    assert measured == pytest.approx(average_age(flight), abs=1e-9)
    made = flight.during("/delay_estimate")
    missing = len(made["epoch"]) - document["commands"] - sum(document["ended"].values())
    assert -1 <= missing <= 15, "under way as the flight begins or ends"


@pytest.mark.parametrize("perception_ms", [70, 130])
def test_stages_of_scans_add_up_to_seen_to_acted(tmp_path, perception_ms):
    """Scans arrive at 33 ms of each 100 ms; commands leave at 8 ms of each 10 ms.

    The perception is done 5 ms before a command. One that takes 130 ms makes scans wait.
    """
    settings = f"cloud.perception_ms={perception_ms}", *CONSTANT
    flight = flight_of(tmp_path, *settings, experiment="gap", lasts_s=4)
    seen, applied = acted(flight)
    lengths = np.diff(budget_of(flight).scans.followed, axis=0)
    assert lengths.min() >= 0
    assert len(seen["stamp_ns"]) > 20
    assert (lengths.sum(axis=0) == applied["stamp_ns"] - seen["seen_stamp_ns"]).all()
    document = budget_of(flight).document
    found = document["scans"]
    measured = SHIPPED["seen_to_acted"].measure(flight)
    assert found["age"]["mean"] == pytest.approx(measured, abs=1e-9)
    means = {name: each["mean"] * 1e3 for name, each in found["stages"].items()}
    own = {"scan_uplink": 33, "scan_compute": perception_ms, "scan_hold": 5}
    known = {**own, "downlink": 21, "wait": 1}
    assert {name: means[name] for name in known} == pytest.approx(known, abs=1e-9)
    assert (means["scan_wait"] > 0) == (perception_ms > 100)
    assert SHIPPED["budget_scan_hold"].measure(flight) * 1e3 == means["scan_hold"]
    assert "waits for the perception" in as_text(document)
    assert "scans" not in budget_of(flight_of(tmp_path, *CONSTANT)).document


def test_constant_delays_give_the_delays_and_the_phases_of_the_periods(tmp_path):
    """33 ms after a period of 10 ms, cloud's next one begins 7 ms later; then 21 ms to world."""
    stages = budget_of(flight_of(tmp_path, *CONSTANT)).document["stages"]
    means = {name: each["mean"] * 1e3 for name, each in stages.items()}
    expected = {"observation": 0, "uplink": 33, "queue": 7, "downlink": 21, "wait": 1}
    assert means == pytest.approx(expected, abs=1e-9)


def test_two_clocks_give_no_negative_stage_and_their_uncertainty_is_told(tmp_path):
    settings = SETTINGS["reordered"]
    alike, apart = (flight_of(tmp_path, *settings, ahead_ns=ns) for ns in (0, 500 * MS))
    alike, apart = budget_of(alike), budget_of(apart)
    assert (apart.followed[[0, -1]] == alike.followed[[0, -1]]).all()
    assert np.diff(apart.followed, axis=0).min() >= 0
    assert [each.name for each in apart.stages] == [each.name for each in alike.stages]
    assert "may be wrong by up to" in apart.document["notes"][0]


def test_without_a_common_clock_both_directions_are_told_together(tmp_path):
    """A clock that goes wrong by 1 % makes negative delays; the time in cloud stays right."""
    world, cloud = records(*CONSTANT)
    wrong = [each._replace(stamp_ns=each.stamp_ns * 101 // 100) for each in cloud]
    path = tmp_path / "mission.mcap"
    both = sorted([*world, *wrong], key=lambda each: each.stamp_ns)
    budget = budget_of(read_flight(write(path, both, "world")))
    means = {name: each["mean"] * 1e3 for name, each in budget.document["stages"].items()}
    assert means["uplink_and_downlink"] == pytest.approx(54, abs=0.2)
    assert means["queue"] == pytest.approx(7, abs=0.2)
    assert np.diff(budget.followed, axis=0).min() >= 0
    assert NO_CLOCK in budget.notes


def test_stamps_out_of_order_by_less_than_a_step_are_put_in_order(tmp_path):
    """World lags behind its busy machine, so telemetry seems to arrive before it is sent."""
    world, cloud = records("link.profile=ideal")
    early = [each._replace(stamp_ns=each.stamp_ns - 9 * MS // 10) for each in cloud]
    both = sorted([*world, *early], key=lambda each: each.stamp_ns)
    flight = read_flight(write(tmp_path / "mission.mcap", both, "world"))
    budget, applied = budget_of(flight), flight.during("/command_applied")
    lengths = np.diff(budget.followed, axis=0)
    assert lengths.min() >= 0
    assert (lengths.sum(axis=0) == applied["stamp_ns"] - applied["basis_stamp_ns"]).all()
    assert [each.name for each in budget.stages][1:4] == ["uplink", "queue", "downlink"]
    assert budget.notes == ()


def test_of_one_end_there_are_round_trips_alone(tmp_path):
    world, cloud = records(*CONSTANT)
    path = write(tmp_path / "world.mcap", world, "world")
    budget = budget_of(read_flight(path)).document
    means = {name: each["mean"] * 1e3 for name, each in budget["stages"].items()}
    expected = {"observation": 0, "uplink_and_queue_and_downlink": 61, "wait": 1}
    assert means == pytest.approx(expected)
    assert budget["notes"] == [ONE_END]
    path = write(tmp_path / "cloud.mcap", cloud, "cloud")
    found = of_flight(read_flight(path)).document
    assert found["round_trips"]["rtt"]["mean"] == pytest.approx(0.055), "with 1 ms for the step"
    assert "55.00" in as_text(found)
    path = write(tmp_path / "nothing.mcap", cloud[:1], "cloud")
    assert of_flight(read_flight(path)).document["round_trips"] == {}


def test_other_commands_are_counted_by_where_they_ended(tmp_path):
    """The guard holds when commands 20 to 39 arrive; 50 to 59 are lost; 70 comes late."""
    world, cloud = records(*CONSTANT)
    known = [each for each in world if isinstance(each, Arrival) and each.counter < 100]
    applied = {each.counter: each for each in world if type(each).__name__ == "CommandApplied"}
    begin, last = known[20].stamp_ns, known[40].stamp_ns
    hidden = [applied[n] for n in (*range(20, 40), *range(50, 60), 70)]
    hidden += [known[n] for n in (*range(50, 60), 70)]
    new = [
        GuardChange(begin, GuardState.HOLD, "test"),
        GuardChange(last, GuardState.TRACK, "test"),
        known[70]._replace(stamp_ns=known[71].stamp_ns + 1, used=False),
    ]
    kept = {id(each) for each in hidden}
    changed = [each for each in world if id(each) not in kept] + new
    both = sorted([*changed, *cloud], key=lambda each: each.stamp_ns)
    budget = budget_of(read_flight(write(tmp_path / "m.mcap", both, "world")))
    assert budget.document["ended"] == {"lost": 10, "superseded": 1, "guard": 20}


def test_a_radio_is_cut_into_its_request_its_slot_and_its_repetitions(tmp_path):
    """Telemetry comes 4 ms before a request slot; slot and grant take a pattern, then a slot."""
    radio = "{slot_ms: .5, tdd: DDDSU, request_ms: 10, grant_ms: 2, error: 0, phase_ms: 8}"
    settings = "link.profile=ideal", "link.uplink.delay_ms=3", f"link.uplink.radio={radio}"
    stages = budget_of(flight_of(tmp_path, *settings)).document["stages"]
    means = {name: each["mean"] * 1e3 for name, each in stages.items()}
    expected = {"uplink_request": 4, "uplink_grant": 3, "uplink": 3}
    assert {name: means[name] for name in expected} == pytest.approx(expected, abs=1e-9)
    assert "uplink_repeat" not in means, "without errors, nothing is sent again"


def test_a_simulated_computation_is_a_stage_of_its_own(tmp_path):
    stages = budget_of(flight_of(tmp_path, *SETTINGS["computes"])).document["stages"]
    assert stages["compute"]["mean"] == pytest.approx(0.007)
    assert "compute" not in budget_of(flight_of(tmp_path, *CONSTANT)).document["stages"]
