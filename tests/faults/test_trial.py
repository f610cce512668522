# SPDX-License-Identifier: Apache-2.0

"""One schedule, flown: what it is checked for, and that a broken part is found."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import pytest

from cloudrc.cloud.operator import EmergencyStopRepeater
from cloudrc.teleop.service import MissionService
from cloudrc.wire.messages import ZERO
from cloudrc.wire.records import CommandApplied, SessionOpened
from cloudrc.wire.tunnel.window import LATE, USED, ReceiveWindow
from cloudrc.world.guard import limits
from cloudrc.world.guard.hold import PositionHold
from cloudrc.world.guard.state import Guard
from tests.conftest import nightly
from tests.faults import trial
from tests.faults.adversary import POLICIES, choose
from tests.faults.invariants import check_order
from tests.faults.schedule import FaultEvent, Schedule, compose, load
from tests.faults.trial import fly

pytestmark = pytest.mark.usefixtures("shared_files")

MS = 1_000_000
REGRESSIONS = sorted((Path(__file__).parent / "regressions").glob("*.yaml"))
SHORT = [path for path in REGRESSIONS if load(path).duration < 30.0]
LONG = [path for path in REGRESSIONS if path not in SHORT]


@pytest.mark.parametrize("path", [*SHORT, *nightly(*LONG)], ids=lambda path: path.stem)
def test_a_schedule_that_found_a_bug_breaks_nothing_now(path):
    assert fly(load(path)).breaches == ()


@pytest.mark.parametrize("seed", nightly(*range(2, 9)))
def test_random_faults_break_no_invariant(seed):
    """Seed 1 is flown daily by the command, in tests/doors/cli."""
    assert fly(compose(seed)).breaches == ()


@pytest.mark.promise("stays-inside-the-fence")
@pytest.mark.parametrize(
    ("robot", "policy"),
    [
        *(("pelican", policy) for policy in sorted(POLICIES)),
        *(("nano", "face-after-face"), ("rover", "hostile-plans"), ("x2", "operators-voice")),
    ],
)
def test_a_hostile_cloud_causes_no_breach(robot, policy):
    seed = next(seed for seed in range(1, 30) if choose(seed).policy == policy)
    assert fly(replace(choose(seed), duration=5.0, robot=robot)).breaches == ()


HELD = Schedule(
    3,
    events=(
        *(FaultEvent("blackout", at, lasts) for at, lasts in ((3.0, 0.4), (3.8, 0.3), (6.0, 1.0))),
        *(FaultEvent("stopped", 8.0), FaultEvent("blackout", 11.0, 2.6)),
    ),
    duration=24.0,
    hold_max=2.0,
)
"""Several HOLDs, a stop, and a LAND."""
STOPPED = Schedule(3, events=(FaultEvent("stopped", 3.0),), duration=13.5)


AWAY = Schedule(1, "ideal", (FaultEvent("blackout", 4.0, 3.0),), duration=9.0)


def ignores(owner, name, value=lambda *_: None):
    return lambda patch: patch.setattr(owner, name, value)


def applies_late_commands(patch):
    take = ReceiveWindow.take
    patch.setattr(ReceiveWindow, "take", lambda *_: USED if (said := take(*_)) == LATE else said)


@pytest.mark.parametrize(
    ("breaks", "kind", "schedule"),
    [
        (lambda patch: None, "", HELD),
        (ignores(limits, "ramp_ns", lambda *_: 0), "cap", replace(HELD, duration=6.0)),
        (ignores(Guard, "_alone_max_ns", 3_600_000 * MS), "hold", replace(HELD, duration=15.0)),
        (applies_late_commands, "order", Schedule(1, reorder=0.5, duration=4.0)),
        (ignores(EmergencyStopRepeater, "sound"), "obeyed", STOPPED),
        (ignores(MissionService, "acknowledge"), "stuck", STOPPED),
        (
            ignores(limits, "limit_to_fence", lambda velocity, *_: velocity),
            *("fence", replace(AWAY, policy="towards-a-face", robot="rover")),
        ),
        (
            ignores(PositionHold, "_brake", lambda hold, reference, *_: reference),
            *("rest", replace(AWAY, policy="random", robot="nano")),
        ),
        (
            ignores(trial, "events_of_missions", lambda *_: [{"mission": "m", "waypoint": 1}]),
            *("waypoint", Schedule(1, duration=0.2)),
        ),
        (
            ignores(MissionService, "pause", Mock(side_effect=OSError)),
            "error",
            Schedule(3, events=(FaultEvent("pod_shut_down", 4.0, 2.0, 0.5),), duration=5.0),
        ),
    ],
)
def test_a_broken_part_is_found(breaks, kind, schedule, monkeypatch):
    breaks(monkeypatch)
    found = fly(schedule).kinds
    assert kind in found if kind else found == set()


@pytest.mark.parametrize(
    ("commands", "kinds"),
    [
        # The stamps are 0, 1, 2...; a new process of world starts at 3.
        ([(2, 0), (2, 1), (2, 5), (1, None), (1, 0)], set()),
        ([(2, 0), (2, 1), (2, 5), (1, 7), (1, 6)], {"order"}),
        ([(3, None), (2, 9)], {"order"}),
    ],
)
def test_a_command_is_applied_once_and_in_order(commands, kinds):
    records = [
        SessionOpened(at, "world", epoch, "cloud said hello")
        if counter is None
        else CommandApplied(at, epoch, counter, 0, ZERO)
        for at, (epoch, counter) in enumerate(commands)
    ]
    assert {breach.kind for breach in check_order(records, [0, 3])} == kinds
