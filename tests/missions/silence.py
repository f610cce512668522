"""Flights whose link falls silent: what the robot does by itself, tick by tick."""

from __future__ import annotations

from math import dist, hypot
from typing import NamedTuple

from flying import LIMIT_NS, join

from cloudrc.config.load import load_experiment
from cloudrc.geometry.clearance import pipe_index
from cloudrc.geometry.scene import load_scene
from cloudrc.messages import GuardState, Vector
from cloudrc.records import CommandApplied, Contact, GuardChange, Record
from cloudrc.world.robot import STEP_NS

BOTH = ("uplink", "downlink")
PATIENCE = (
    "criteria.time_limit_s=200",
    *(f"mission.waypoints.{k}.time_limit_s=200" for k in range(7)),
)
"""So that no limit of time ends a mission that waits for its link."""
SLOW = ("cloud.controller.speed_max=1.5",)


class Instant(NamedTuple):
    """The robot after one tick."""

    stamp_ns: int
    state: GuardState
    position: Vector
    speed: float


class Silence(NamedTuple):
    """A flight with one silence in it; times [s] since the start of the silence or of the HOLD.

    Attributes:
        pipe: Index of the one that the base was in when the silence began; -1 for none.
        outcome: Of the mission.
        held_after: From the start of the silence to HOLD; None if there was none.
        basis_age: How old what the newest applied command was computed from is at HOLD.
        calm_after: From HOLD on until the speed stays below 0.05 m/s, up to the link's return.
        drift: Farthest from where the robot first came to rest [m], up to the link's return.
        resumed_after: From the link's return to TRACK.
        speed: When HOLD began [m/s].
        touched: What was touched, but for the board by the arm's tip.
    """

    pipe: int
    outcome: str
    held_after: float | None
    basis_age: float
    calm_after: float
    drift: float
    resumed_after: float | None
    speed: float
    touched: list[str]


def fly_through(
    start_s: float, duration_s: float, *settings: str, ways: tuple[str, ...] = BOTH
) -> Silence:
    """Fly `paper` with a silence of one or both directions."""
    blackouts = [
        f"link.{way}.blackouts=[{{start_s: {start_s}, duration_s: {duration_s}}}]" for way in ways
    ]
    experiment = load_experiment("paper", [*PATIENCE, *blackouts, *settings])
    ends = join(experiment)
    records: list[Record] = []
    trace: list[Instant] = []
    begin_ns, end_ns = round(start_s * 1e9), round((start_s + duration_s) * 1e9)
    _watch(ends.world.robot, trace, begin_ns)

    def over() -> bool:
        return ends.cloud.mission_over and ends.run.now_ns > end_ns

    ends.run.fly(over, LIMIT_NS, lambda w, c: records.extend(w))
    outcome = ends.cloud.teleop.outcome
    changes = [r for r in records if isinstance(r, GuardChange) and r.stamp_ns >= begin_ns]
    held = next((c for c in changes if c.state is GuardState.HOLD), None)
    contacts = [r for r in records if isinstance(r, Contact)]
    touched = [r.body for r in contacts if r.body != "board" or not r.tip]
    code = outcome.code if outcome else "none"
    (pipe,) = pipe_index(load_scene(experiment.world.scene), trace[0].position).tolist()
    if held is None or held.cause == "mission ended":
        return Silence(pipe, code, None, 0.0, 0.0, 0.0, None, 0.0, touched)
    held_ns = held.stamp_ns
    bases_ns = [
        r.basis_stamp_ns for r in records if isinstance(r, CommandApplied) and r.stamp_ns <= held_ns
    ]
    silent = [i for i in trace if held_ns <= i.stamp_ns <= max(end_ns, held_ns + STEP_NS)]
    fast = [i.stamp_ns for i in silent if i.speed >= 0.05]
    rest = next((i.position for i in silent if i.speed < 0.05), None)
    still = silent[next((k for k, i in enumerate(silent) if i.position is rest), 0) :]
    back = [c.stamp_ns for c in changes if c.state is GuardState.TRACK and c.stamp_ns > held_ns]
    return Silence(
        pipe,
        code,
        (held_ns - begin_ns) * 1e-9,
        (held_ns - max(bases_ns)) * 1e-9,
        (fast[-1] + STEP_NS - held_ns) * 1e-9 if fast else 0.0,
        max(dist(i.position, rest) for i in still) if rest else 0.0,
        (back[0] - end_ns) * 1e-9 if back else None,
        silent[0].speed,
        touched,
    )


def _watch(robot, trace: list[Instant], begin_ns: int) -> None:
    """Note the robot after every tick from `begin_ns` on."""
    guard, simulator, tick = robot.guard, robot.simulator, robot.guard.tick

    def noting(now_ns, readings, dt):
        reference = tick(now_ns, readings, dt)
        if now_ns >= begin_ns:
            speed = hypot(*readings.velocity)
            trace.append(Instant(now_ns, guard.state, simulator.readings.position, speed))
        return reference

    guard.tick = noting
