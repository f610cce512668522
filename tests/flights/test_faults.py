# SPDX-License-Identifier: Apache-2.0

"""Each fault of processes and clocks shows its reaction in the recording of a flight."""

from functools import cache

import pytest

from cloudrc.config.faults import FaultConfig
from cloudrc.config.load import load_experiment
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.flight.virtual.faults import faulty_clock
from cloudrc.flight.virtual.run import Clock
from cloudrc.wire.messages import GuardState

pytestmark = pytest.mark.usefixtures("shared_files")

SECOND = 10**9
CLOUD_KILLED = "kind: cloud_killed, at_s: 4, duration_s: 0.8"
CLOUD_PAUSED = "kind: cloud_paused, at_s: 4, duration_s: 2"
TELEOP_KILLED = "kind: teleop_killed, at_s: 4, duration_s: 1"
WORLD_PAUSED = "kind: world_paused, at_s: 4, duration_s: 1"
CLOCK_STEP = "kind: clock_step, at_s: 4, step_s: 3"
CLOCK_DRIFT = "kind: clock_drift, at_s: 2, duration_s: 4, drift_ppm: 500"


@cache
def fly(*faults, seed=1):
    texts = ", ".join(f"{{{fault}}}" for fault in faults)
    few = "link.profile=lte", "mission.steps.count=2", f"seed={seed}"
    return fly_in_memory(load_experiment("steps", [*few, f"faults=[{texts}]"]))


def seconds(flown, topic, column, value):
    """Return the times at which a column of a topic has this value [s]."""
    table = flown.flight.recording[topic]
    return (table["stamp_ns"][table[column] == value] * 1e-9).tolist()


def holds(flown):
    """Return when HOLD begins, but for that at the end of the mission [s]."""
    return seconds(flown, "/guard", "state", GuardState.HOLD)[:-1]


@pytest.mark.parametrize(("fault", "end"), [(CLOUD_KILLED, 4.8), (CLOUD_PAUSED, 6.0)])
def test_without_cloud_the_robot_holds_until_cloud_commands_again(fault, end):
    flown = fly(fault)
    (held,) = holds(flown)
    assert 4.0 < held < 4.3
    assert end < seconds(flown, "/guard", "state", GuardState.TRACK)[-1] < end + 0.5
    assert flown.verdict.outcome == "success"


@pytest.mark.parametrize(("fault", "opened"), [(CLOUD_KILLED, 1), (CLOUD_PAUSED, 0)])
def test_only_a_new_cloud_opens_a_session(fault, opened):
    usual, found = (seconds(each, "/session", "end", "world") for each in (fly(), fly(fault)))
    assert len(found) - len(usual) == opened


def test_a_new_teleop_goes_on_with_the_mission():
    flown = fly(TELEOP_KILLED)
    assert holds(flown) == []
    events = flown.flight.recording["/mission"]["event"].tolist()
    assert events == ["started", "resumed", "reached", "reached", "done"]
    assert seconds(flown, "/mission", "event", "resumed")[0] == pytest.approx(5.0, abs=0.1)


def test_the_robot_stands_still_with_world():
    flown = fly(WORLD_PAUSED)
    slip = flown.flight.recording["/telemetry"]["slip_ns"]
    assert slip[-1] == pytest.approx(SECOND, abs=0.1 * SECOND)
    assert seconds(flown, "/fault", "code", "late")


@pytest.mark.parametrize("fault", [CLOCK_STEP, CLOCK_DRIFT])
def test_cloud_s_clock_causes_no_hold(fault):
    flown = fly(fault)
    assert holds(flown) == []
    assert flown.verdict.outcome == "success"


def test_the_hash_of_a_flight_depends_on_its_seed_and_its_faults():
    kinds = CLOUD_KILLED, CLOUD_PAUSED, TELEOP_KILLED, WORLD_PAUSED, CLOCK_STEP, CLOCK_DRIFT
    hashes = [fly().records_sha256, *(fly(kind).records_sha256 for kind in kinds)]
    others = fly(CLOUD_KILLED, seed=2), fly(CLOUD_KILLED.replace("4", "5"))
    assert len({*hashes, *(each.records_sha256 for each in others)}) == len(kinds) + 3
    again = fly.__wrapped__(CLOUD_KILLED)
    assert again.records_sha256 == fly(CLOUD_KILLED).records_sha256


def test_a_clock_steps_and_drifts_and_never_goes_back():
    faults = [
        FaultConfig(kind="clock_step", at_s=2.0, step_s=5.0),
        FaultConfig(kind="clock_drift", at_s=3.0, duration_s=4.0, drift_ppm=1000),
    ]
    clock = faulty_clock(Clock(SECOND), faults)
    shown = [clock.at(n * SECOND) for n in range(9)]
    assert shown == [
        n * SECOND + k
        for n, k in enumerate(
            [SECOND] * 2 + [6 * SECOND] * 2 + [6 * SECOND + k * 10**6 for k in (1, 2, 3, 4, 4)]
        )
    ]
    for own_ns in (0, SECOND, 3 * SECOND, 8 * SECOND, 9 * SECOND + 12_345, 20 * SECOND):
        now_ns = clock.when(own_ns)
        assert clock.at(now_ns - 1) < own_ns <= clock.at(now_ns)
    assert clock.when(5 * SECOND) == 2 * SECOND, "the step jumps over it"
    assert faulty_clock(Clock(), []) == Clock()


def test_a_fault_after_the_end_of_the_mission_is_told():
    in_time, late = (fly(f"kind: clock_step, at_s: {at}, step_s: 3").notes for at in (4, 300))
    assert not [note for note in in_time if "clock_step" in note]
    (note,) = [note for note in late if "clock_step" in note]
    assert note.startswith("The fault clock_step at 300 s did nothing")
