# SPDX-License-Identifier: Apache-2.0

"""Let a perception look again at what cloud had in a recorded flight, and compare its setpoints."""

from __future__ import annotations

from collections import defaultdict, deque
from collections.abc import Iterator
from functools import partial
from itertools import starmap
from math import dist, isfinite, nan, radians
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cloudrc.base import plugins
from cloudrc.base.errors import describe_error
from cloudrc.base.outside.code import attempt
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.cloud.perceiving import judge
from cloudrc.cloud.perceptions import Frame, Perception, Scan
from cloudrc.config.choice import PlugIn
from cloudrc.config.overrides import build_plugin
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.physics.geometry.rays import angles_of
from cloudrc.results.metrics.flight import rows_of
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.flown import flight_of
from cloudrc.results.report.folder import read_flown
from cloudrc.wire.messages import Odometry, Setpoint, Vector
from cloudrc.wire.pictures import Jpeg


class SecondLook(NamedTuple):
    """What two perceptions made of the same thing seen."""

    time: float  # at which it was taken, since the mission's start [s]
    setpoint: Setpoint | None  # of the perception; None: none
    flown: Vector | None  # position of the setpoint in the flight [m]; None: none
    error: str  # why the perception failed; "" if it did not

    @property
    def apart(self) -> float:
        """Distance between the two setpoints [m]; NaN without both."""
        if self.setpoint is None or self.flown is None:
            return nan
        return dist(self.setpoint.position, self.flown)


def look_again(run: Path, name: str | None) -> list[SecondLook]:
    """Let a perception look at the pictures or scans of a run, its folder or its MCAP file.

    `name` is a perception's name or file; None: that of the flight.

    Raises:
        InvalidValueError: If the run has nothing to look at, or no perception.
    """
    recording, experiment = read_flown(run)
    perception = _build(experiment, name)
    return [*_look(recording, experiment, perception)]


def _build(experiment: ResolvedExperiment, name: str | None) -> Perception:
    choice = experiment.cloud.perception
    if name is not None:
        choice = PlugIn(name=str(Path(name).resolve()) if plugins.is_path(name) else name)
    if choice is None:
        raise InvalidValueError("the flight had no perception; name one with --perception")
    perception: Perception = build_plugin("perceptions", choice, robot=experiment.robot_facts)
    return perception


def _look(
    recording: Recording, experiment: ResolvedExperiment, perception: Perception
) -> Iterator[SecondLook]:
    """Let it look from the mission's start on, with the newest odometry of the time.

    Cloud may have had an older one, and a perception that was busy saw less.
    """
    flight, odometry = flight_of(recording, experiment), recording["/odometry"]
    fence, steered = experiment.world.files.fence, recording["/perception"]
    flown = dict(rows_of(steered, "seen_stamp_ns", "position"))
    measured = [*starmap(Odometry, rows_of(odometry, "stamp_ns", *Odometry._fields[1:]))]

    def see(seen: Scan | Frame, at: Odometry) -> Setpoint | None:
        result = perception.see(seen, at)
        return None if result is None else judge(result, fence.inner_low, fence.inner_high)

    perception.reset()
    for seen in _seen(recording, experiment, perception.takes):
        row = int(np.searchsorted(odometry["stamp_ns"], seen.stamp_ns, side="right")) - 1
        now = float(flight.seconds(seen.stamp_ns))
        if row < 0 or now < 0.0:
            continue
        setpoint, error = attempt(partial(see, seen, measured[row]))
        place = flown.get(seen.stamp_ns)
        why = "" if error is None else describe_error(error)
        known = place is not None and isfinite(place[0])
        yield SecondLook(now, setpoint, place if known else None, why)


def _seen(
    recording: Recording, experiment: ResolvedExperiment, sensor: str
) -> Iterator[Scan | Frame]:
    """Yield what cloud had, in the order in which it was shown."""
    robot = experiment.robot
    kept = recording["/scan" if sensor == "scan" else "/camera"]
    if not len(kept):
        kind = "scans" if sensor == "scan" else "pictures; fly again with --set camera.keep=true"
        raise InvalidValueError(f"the recording has no {kind}")
    if robot.scan is not None and sensor == "scan":
        angles = angles_of(robot.scan.rays, robot.scan.fov_deg)
        for stamp_ns, ranges in rows_of(kept, "stamp_ns", "ranges"):
            yield Scan(stamp_ns, np.array(ranges), angles)
    elif robot.camera is not None:
        fovy, files = radians(robot.camera.fovy_deg), Jpeg()  # it reads PNG, too
        taken = defaultdict[int, deque[tuple[int, int]]](deque)  # several may come at one time
        for stamp_ns, *which in rows_of(
            recording["/frame_shown"], "stamp_ns", "taken_ns", "number"
        ):
            taken[stamp_ns].append((which[0], which[1]))
        for stamp_ns, data in rows_of(kept, "stamp_ns", "data"):
            image = files.decode(data)
            if taken[stamp_ns] and image is not None:
                yield Frame(*taken[stamp_ns].popleft(), image, fovy)


def summarize(looks: list[SecondLook]) -> dict[str, float | int | None]:
    """Return what the looks of a flight have in common."""
    apart = [each.apart for each in looks if isfinite(each.apart)]
    return {
        "seen": len(looks),
        "setpoints": sum(each.setpoint is not None for each in looks),
        "setpoints_flown": sum(each.flown is not None for each in looks),
        "failed": sum(bool(each.error) for each in looks),
        "apart_mean_m": sum(apart) / len(apart) if apart else None,
        "apart_max_m": max(apart, default=None),
    }
