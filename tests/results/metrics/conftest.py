# SPDX-License-Identifier: Apache-2.0

"""Synthetic flights with known numbers.

The robot flies at 1 m/s along x from the origin at a height of 1 m, with 25 telemetries and
commands per second. The mission lasts from 10 s to 20 s on the shared clock of both ends.
"""

from dataclasses import dataclass, field
from functools import cache

from cloudrc.config.load import load_experiment
from cloudrc.config.schema import Criteria, MissionConfig, Touch, Waypoint
from cloudrc.config.world import ResolvedWorld
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.physics.geometry.scene import Plate, Scene, Tube
from cloudrc.results.metrics.flight import Flight
from cloudrc.results.metrics.measure import SHIPPED, measure_all
from cloudrc.results.metrics.verdict import flight_evidence, judge
from cloudrc.results.record.columns import Recording
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.wire.records import (
    Arrival,
    CommandApplied,
    Contact,
    ContactForce,
    GroundTruth,
    GuardChange,
    MissionEvent,
    Record,
    SessionOpened,
    TelemetrySent,
)
from tests.doors.console.conftest import control

SECOND = 1_000_000_000
START, DONE, END = 10 * SECOND, 20 * SECOND, 25 * SECOND
PERIOD = 40_000_000
UPLINK, DOWNLINK, HORIZON = 0.05, 0.04, 0.08

OPEN_AIR = Scene("empty")
PELICAN = ResolvedWorld(robot="pelican").files.hull
ONE_PIPE = Scene(
    "pipe",
    (Tube("pipe_1", (4.5, 0.0, 1.0), (1.0, 0.0, 0.0), 5.0, 0.662, 0.7),),
    (Plate("board", 10.0, (-0.5, 0.5), (0.0, 1.5)),),
)


def at(seconds):
    """Return the stamp of a time [s] after the start."""
    return START + round(seconds * SECOND)


def straight(seconds):
    return (seconds, 0.0, 1.0)


def measured(flight, name):
    """Return the number of a flight that a metric of cloudrc gives."""
    return SHIPPED[name].measure(flight)


def judged(flight, numbers=None, *, real_time=False, interrupted=False, **asked):
    """Return the verdict on a flight, by default with the numbers that it has."""
    numbers = measure_all(flight).numbers if numbers is None else numbers
    known = flight_evidence(flight, numbers, real_time=real_time, interrupted=interrupted, **asked)
    return judge(known)


def to_point(x, tolerance, dwell=0.0, **more):
    """Make a mission to the point `x` [m] on the way along x."""
    point = Waypoint(position_m=(x, 0.0, 1.0), tolerance_m=tolerance, dwell_s=dwell, **more)
    return MissionConfig(waypoints=(point,))


@dataclass
class Log:
    """Records of both ends; a test may change them before it makes a flight of them."""

    world: list[Record] = field(default_factory=list)
    cloud: list[Record] = field(default_factory=list)

    def change(self, kind, how):
        """Replace the n-th record of a class by `how(n, record)`; None removes it."""
        for records in (self.world, self.cloud):
            found = [each for each in records if isinstance(each, kind)]
            new = iter([how(n, record) for n, record in enumerate(found)])
            changed = [next(new) if isinstance(each, kind) else each for each in records]
            records[:] = [each for each in changed if each is not None]

    def keep(self, wanted):
        """Drop the records whose stamps [ns] are not `wanted`."""
        for records in (self.world, self.cloud):
            records[:] = [each for each in records if wanted(each.stamp_ns)]

    def tell(self, how):
        """Replace those values of each telemetry that `how(sent)` returns."""

        def told(_, sent):
            return sent._replace(telemetry=sent.telemetry._replace(**how(sent)))

        self.change(TelemetrySent, told)

    def flight(
        self, scene=OPEN_AIR, *, waypoints=1, mission=None, time_limit=60.0, touch=None, **criteria
    ):
        anywhere = to_point(10.0, 10.0).waypoints
        mission = mission or MissionConfig(waypoints=anywhere * waypoints)
        return Flight(
            Recording.from_records(*self.ends()),
            Criteria(time_limit_s=time_limit, **criteria),
            mission.model_copy(update={"touch": touch and Touch(body=touch)}),
            scene,
            PELICAN,
        )

    def ends(self):
        """Return the records of world and of cloud by stamp; equal stamps keep their order."""
        world, cloud = (sorted(r, key=lambda each: each.stamp_ns) for r in (self.world, self.cloud))
        return world, cloud


def flown(path=straight):
    """Log a flight along `path`: position [m] as a function of time since the start [s]."""
    log = Log()
    log.world += [
        SessionOpened(START - SECOND, "world", 1, "cloud said hello"),
        SessionOpened(START, "world", 2, "mission starts from spawn"),
        GuardChange(START - SECOND, GuardState.GROUND, "at the spawn"),
        GuardChange(START, GuardState.TRACK, "fresh command"),
        GuardChange(DONE + PERIOD, GuardState.HOLD, "mission ended"),
    ]
    log.cloud += [
        MissionEvent(START - SECOND, "started", 0, "mission started"),
        MissionEvent(DONE, "reached", 0, "waypoint 1 reached"),
        MissionEvent(DONE, "done", 0, "mission done"),
    ]
    for counter, stamp in enumerate(range(START - SECOND, END + 1, PERIOD)):
        _step(log, counter, stamp, path)
    return log


def _step(log, counter, stamp, path):
    odometry = Odometry(stamp, path((stamp - START) / SECOND), UPRIGHT, (1.0, 0.0, 0.0), ZERO)
    # The command of two periods before was applied one period before.
    telemetry = Telemetry(stamp, odometry, (), stamp - 2 * PERIOD, PERIOD, 0, 1, GuardState.TRACK)
    arrival, applied = stamp + round(UPLINK * SECOND), stamp + round(DOWNLINK * SECOND)
    basis = stamp - round(UPLINK * SECOND)
    x, y, z = path((applied - START) / SECOND)
    measured = path((basis - START) / SECOND)
    log.world += [
        TelemetrySent(stamp, 2, counter, telemetry),
        GroundTruth(stamp, odometry, ZERO),
        ContactForce(stamp, 0.0, 0.0, 0.0),
        Arrival(applied, False, 2, counter, DOWNLINK, True),
        CommandApplied(applied, 2, counter, basis, ZERO),
    ]
    log.cloud.append(Arrival(arrival, True, 2, counter, UPLINK, True))
    fields = dict(epoch=2, counter=counter, horizon=HORIZON, measured=measured)
    fields |= dict(rtt=UPLINK + DOWNLINK, loop_delay=UPLINK + DOWNLINK + 0.005)
    fields["position"] = (x + 0.003, y + 0.004, z)
    fields["setpoint"] = (measured[0] + 0.3, measured[1] + 0.4, measured[2])
    log.cloud.append(control(stamp / SECOND, basis / SECOND, velocity=(1.0, 0.0, 0.0), **fields))


@cache
def straight_flight():
    """Return the flight through open air; tests must not change it."""
    return flown().flight()


def touch(seconds, body="board", *, by_probe=True):
    """Make a contact with the probe at 0.15 m/s."""
    return Contact(at(seconds), body, straight(seconds), ZERO, (0.12, 0.09, 0.0), by_probe)


def good():
    """Log a flight whose probe touches the board slowly."""
    log = flown()
    log.world.append(touch(8))
    return log


def pressing(log, since, force):
    """Apply a force to the probe from a time on [s since the start]; the peak is 10 N higher."""

    def press(n, row):
        if row.stamp_ns < at(since):
            return row
        newton = force(n)
        return ContactForce(row.stamp_ns, newton, newton + 10, newton * PERIOD / SECOND)

    log.change(ContactForce, press)


@cache
def paper():
    """Fly the shipped experiment once in virtual time."""
    experiment = load_experiment("paper")
    return experiment, fly_in_memory(experiment).flight.recording
