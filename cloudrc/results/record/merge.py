# SPDX-License-Identifier: Apache-2.0

"""Merge the recordings of world and cloud into one recording of a mission, on world's clock.

Only the stamp of a cloud message is converted; other times in the message stay on the clock that
their description names.

On two machines, the offset between the clocks is estimated from the packets, because no packet
arrives before it was sent. Each telemetry datagram shows that world's clock is ahead of cloud's by
at least (sent - arrived). Each command datagram shows that world's clock is ahead by at most
(arrived - sent). The fastest packet of each direction gives the narrowest interval: as wide as the
sum of both delays.

On one machine, world's clock differs from cloud's only by the lag after stalls of world's process.
Telemetry contains this lag.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from operator import itemgetter
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.errors import CloudrcError
from cloudrc.results.record import part_before
from cloudrc.results.record.columns import Recording, Table, datagrams, join
from cloudrc.results.record.holes import END_NS, SOMEWHERE, Hole, union
from cloudrc.results.record.topics import TOPICS
from cloudrc.wire.records import UNDER_WAY

KILLED = "a fault killed the process, whose last records are lost"
BEFORE_NS, AFTER_NS = 1_000_000_000, 2_000_000_000
"""A cut recording begins BEFORE_NS before the mission's start and ends AFTER_NS after its end [ns].
It thus includes the start of the session and the guard's first change of state."""
COUNTED_NS = 2_500_000_000
"""Time before its other records from which a cut recording has the counters [ns]: longer than the
2 s between two records of a counter of the link. So the growth in the flight is known."""


class ClockOffset(NamedTuple):
    """The offset between world's clock and cloud's clock."""

    offset_ns: int  # world's clock minus cloud's clock [ns], which is added to cloud's stamps
    uncertainty_ns: int | None  # largest possible error [ns]; None if unknown
    # "first records": the clocks are unrelated, and both recordings are assumed to begin together
    method: Literal["same clock", "packets", "first records"]

    def metadata(self) -> dict[str, str]:
        """Format the clock offset for a file's metadata; leave out an unknown uncertainty."""
        noted = {"clock_offset_ns": str(self.offset_ns), "clock_offset_method": self.method}
        if self.uncertainty_ns is not None:
            noted["clock_offset_uncertainty_ns"] = str(self.uncertainty_ns)
        return noted


SAME_CLOCK = ClockOffset(0, 0, "same clock")


def clock_offset(world: Recording, cloud: Recording) -> ClockOffset:
    """Estimate world's clock minus cloud's clock.

    No packet arrives before it was sent. The packets of each direction therefore bound the offset
    on one side, and the estimate is the centre between both bounds. If a direction has no packets,
    the estimate is the difference of the first stamps.

    Source: the clock filter of RFC 5905 (NTP), section 10: it uses the sample with the smallest
    round trip, and half of this round trip bounds the error.
    Deviation: each direction uses its own fastest packet. Clock drift is not modelled (50 ppm are 3
    ms per minute).
    """
    uplink = _smallest_difference(world["/telemetry"], cloud["/uplink_delay"])
    downlink = _smallest_difference(cloud["/delay_estimate"], world["/downlink_delay"])
    if uplink is None or downlink is None:
        return ClockOffset(_first_ns(world) - _first_ns(cloud), None, "first records")
    # uplink = d1 - offset and downlink = d2 + offset, where d1, d2 >= 0 are one-way delays.
    uncertainty_ns = (abs(downlink + uplink) + 1) // 2
    return ClockOffset((downlink - uplink) // 2, uncertainty_ns, "packets")


def _smallest_difference(sent: Table, arrived: Table) -> int | None:
    """Return the least (arrival stamp - sending stamp) of a packet [ns]; None if none arrived."""
    rows, source = join(datagrams(arrived), datagrams(sent))
    differences = arrived["stamp_ns"][rows] - sent["stamp_ns"][source]
    return int(differences.min()) if len(rows) else None


def _first_ns(recording: Recording) -> int:
    stamps = [int(recording[topic]["stamp_ns"][0]) for topic in TOPICS if len(recording[topic])]
    return min(stamps, default=0)


def world_time_ns(telemetry: Table, machine_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert times [ns], shape (n,), from the clock of world's machine to world's clock.

    World's clock is behind the machine's clock after a stall. Telemetry contains this lag; between
    two telemetry stamps, the lag is interpolated linearly. The times stay in their order.
    """
    return machine_ns - _lag_ns(telemetry, telemetry["stamp_ns"] + telemetry["slip_ns"], machine_ns)


def machine_time_ns(telemetry: Table, world_ns: NDArray[np.int64]) -> NDArray[np.int64]:
    """Convert times [ns], shape (n,), from world's clock to the clock of world's machine.

    This is the inverse of `world_time_ns`.
    """
    return world_ns + _lag_ns(telemetry, telemetry["stamp_ns"], world_ns)


def _lag_ns(
    telemetry: Table, known_ns: NDArray[np.int64], at_ns: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Interpolate the lag of world's clock, known at `known_ns` [ns], at the times `at_ns` [ns]."""
    if not telemetry["slip_ns"].any():
        return np.zeros_like(at_ns)
    # Differences are exact in float64; the stamps themselves need not be.
    since, known = ((each - known_ns[0]).astype(float) for each in (at_ns, known_ns))
    lag_ns: NDArray[np.int64] = np.rint(np.interp(since, known, telemetry["slip_ns"])).astype(int)
    return lag_ns


def merge(
    world: Path, cloud: Path, last_ns: int | None = None, *, killed: bool = False
) -> Recording:
    """Merge the files of world and cloud, complete or torn, into one mission on world's clock.

    With `last_ns`, read the messages of the last time [ns] at least. What was recorded before a
    file was begun is read, too, if it is complete, or if the process was `killed` on purpose.

    If one file cannot be read, the result contains only the other file, on that file's own clock,
    and a note. It is an error if neither file can be read.
    """
    found: dict[str, Recording] = {}
    failures = []
    for end, path in (("world", world), ("cloud", cloud)):
        try:
            found[end] = _read(path, last_ns, killed=killed)
        except CloudrcError as error:
            failures.append(error)
    if not found:
        raise failures[0]
    mission = next(iter(found.values())) if failures else _join(found["world"], found["cloud"])
    lacking, told = (
        [f"{end}: {text}" for end, one in found.items() if (text := getattr(one, name))]
        for name in ("lacking", "told")
    )
    mission.lacking = "; ".join(lacking)
    mission.told = "; ".join([*told, *map(str, failures)])
    if failures:
        mission.holes = (SOMEWHERE,)
    return mission


def _read(path: Path, last_ns: int | None, *, killed: bool) -> Recording:
    """Read a recording, and the part before it, if both have stamps of one clock.

    The part must be complete, unless its process was `killed`: then its lost end becomes a hole.
    """
    recording, earlier = Recording.read(path, last_ns=last_ns), part_before(path)
    newer = recording.messages
    is_enough = bool(newer) and newer[0][1] < newer[-1][1] - (last_ns or END_NS)
    if is_enough or not earlier.is_file():
        return recording
    try:
        before = Recording.read(earlier, last_ns=last_ns)
    except CloudrcError:  # of a process that was killed at once
        return recording
    # Whoever copied the files while a recorder began anew may have the same part twice.
    older = before.messages
    follows = bool(older) and (not newer or older[0][1] < newer[0][1])
    same_clock = before.metadata.get("clock_id") == recording.metadata.get("clock_id")
    if follows and same_clock and (killed or not before.lacking):
        recording.messages = sorted([*older, *newer], key=itemgetter(1))
        goes_on_ns = newer[0][1] if newer and before.lacking else END_NS
        holes = [hole._replace(end_ns=min(hole.end_ns, goes_on_ns)) for hole in before.holes]
        recording.holes = union([*holes, *recording.holes])
        lost = KILLED if before.lacking else ""
        recording.told = "; ".join(filter(None, [before.told, lost, recording.told]))
    return recording


def _join(world: Recording, cloud: Recording) -> Recording:
    offset, clock_id = SAME_CLOCK, world.metadata.get("clock_id")
    if not clock_id or clock_id != cloud.metadata.get("clock_id"):
        offset = clock_offset(world, cloud)

    def moved(times_ns: list[int]) -> list[int]:
        """Convert times [ns] from cloud's clock to world's clock."""
        if offset is not SAME_CLOCK:
            return [time_ns + offset.offset_ns for time_ns in times_ns]
        there_ns = np.array(times_ns, dtype=np.int64)
        here_ns: list[int] = world_time_ns(world["/telemetry"], there_ns).tolist()
        return here_ns

    # Here, because metrics and names of numbers need no package of an extra.
    from cloudrc.results.record.ros import shifted

    logged_ns = [message[1] for message in cloud.messages]
    messages = [
        (topic, to_ns, shifted(data, to_ns - from_ns))
        for (topic, from_ns, data), to_ns in zip(cloud.messages, moved(logged_ns), strict=True)
    ]
    in_order = heapq.merge(world.messages, messages, key=itemgetter(1))
    return Recording(
        messages=[(topic, max(ns, 0), data) for topic, ns, data in in_order],  # MCAP's least time
        metadata={**cloud.metadata, **world.metadata, **offset.metadata()},
        attachments={**cloud.attachments, **world.attachments},
        source=f"{world.source} or {cloud.source}",
        holes=union([*world.holes, *(_moved(hole, moved) for hole in cloud.holes)]),
    )


def _moved(hole: Hole, moved: Callable[[list[int]], list[int]]) -> Hole:
    """Convert a hole by `moved`; a side of it without a message stays so."""
    begin_ns, end_ns = moved([*hole])
    begin_ns = max(begin_ns, 0) if hole.begin_ns else 0
    return Hole(begin_ns, end_ns if hole.end_ns < END_NS else END_NS)


def cut_to_last_mission(
    mission: Recording,
    *,
    being_written: bool = False,
    after_ns: int = AFTER_NS,
    number: int | None = None,
) -> bool:
    """Reduce a recording of several missions to the mission that was started last.

    With `number`, which telemetry has as `mission_id`, reduce it to this mission.

    `being_written` tells that pods still write the files. If such files contain the end of the
    mission, they have lost nothing; files of a session that was killed may have. The recording ends
    `after_ns` after the end of the mission [ns].

    Return whether the recording contains the end of that mission.
    """
    found = _missions(mission) or [(None, None)]
    index = len(found) - 1 if number is None else _index(mission, found, number)
    (began, ended), after = found[index], found[index + 1 : index + 2]
    earlier = max((end for _, end in found[:index] if end is not None), default=-1)
    first = max((began or 0) - BEFORE_NS, earlier + 1)
    last = ended + after_ns if ended is not None else END_NS
    last = min([last, *(start - 1 for start, _ in after if start is not None)])
    until = mission.messages[-1][1] if mission.messages else 0
    mission.keep(first, last, first - COUNTED_NS)
    if ended is None or until <= ended:
        return False
    if any(hole.begin_ns <= ended and hole.end_ns >= END_NS for hole in mission.holes):
        return False  # of one end, the file is cut short before the mission's end
    if being_written:
        mission.lacking = ""
        mission.holes = tuple(hole for hole in mission.holes if hole.begin_ns < ended)
    return True


def _index(mission: Recording, missions: list[tuple[int | None, int | None]], number: int) -> int:
    """Return which of the `missions` has this number in telemetry, else the last one."""
    telemetry = mission["/telemetry"]
    seen_ns = telemetry["stamp_ns"][telemetry["mission_id"] == number]
    if len(seen_ns):
        for index, (_, ended) in enumerate(missions):
            if ended is None or ended >= seen_ns[0]:
                return index
    return len(missions) - 1


def _missions(mission: Recording) -> list[tuple[int | None, int | None]]:
    """List start and end of each mission by log time [ns]; None if the event is missing."""
    found = list[tuple[int | None, int | None]]()
    # The log time of an event is later than its stamp.
    logged_ns = [message[1] for message in mission.messages if message[0] == "/mission"]
    for time_ns, event in zip(logged_ns, mission["/mission"]["event"], strict=True):
        over = event not in UNDER_WAY
        if event == "started":
            found.append((time_ns, None))
        elif not found or (found[-1][1] is not None and not over):  # its start is lost
            found.append((None, None))
        if over and found[-1][1] is None:
            found[-1] = found[-1][0], time_ns
    return found
