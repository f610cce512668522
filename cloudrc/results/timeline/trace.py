# SPDX-License-Identifier: Apache-2.0

"""Write loops in Chrome's trace format, which Perfetto (ui.perfetto.dev) and Chrome show offline.

Each stage of a command is a slice on a track of the stage, and a flow joins its slices. A scan that
a perception has seen has tracks of its own, and its flow ends in its command. Slices that overlap
are on tracks of their own, because a viewer would drop one of two on the same track.

Source: "Trace Event Format", Google, 2016; Perfetto, docs/getting-started/other-formats.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from itertools import count, islice, pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from cloudrc.results.metrics.budget import ENDS, UNKNOWN_NS, Budget
from cloudrc.results.timeline.loops import GUARD, MISSION, Loop

IN_FORCE = "command in force"
"""Name of the track behind the last stage."""
LANES = 1000
"""Largest number of tracks of a stage."""
COUNTER = 0xFFFFFFFF
"""Bits of a datagram's number that are its counter."""
Event = dict[str, Any]


def write_trace(loops: Mapping[str, Loop], begin: float, end: float) -> bytes:
    """Return the content of a trace file of loops, by the names of their robots.

    It has what began from `begin` to `end` [s since the begin of each].
    """
    flows, events = count(1), list[Event]()
    for process, (name, loop) in enumerate(loops.items(), start=1):
        span_ns = loop.begin_ns + round(begin * 1e9), loop.begin_ns + round(end * 1e9)
        tracks = _Tracks(loop, span_ns, flows)
        for event in tracks.events(name):
            event["pid"] = process  # an hour's events fill much memory: no copies
            events.append(event)
    document = {"traceEvents": events, "displayTimeUnit": "ms"}
    return json.dumps(document, separators=(",", ":")).encode()


class _Tracks:
    """The tracks of a loop, each with its events."""

    def __init__(self, loop: Loop, span_ns: tuple[int, int], flows: Iterator[int]) -> None:
        """Show what begins in a time [ns], without its end; `flows` gives each flow a number."""
        self._loop, self._flows = loop, flows
        self._begin_ns, self._end_ns = span_ns
        used = {each.track for each in loop.marks} | {each.track for each in loop.phases}
        others = sorted(used & {GUARD, MISSION})
        scan_stages = loop.budget.scans.stages if loop.budget.scans else ()
        # The other stages of a scan are those of its command.
        before = [each.text for each in scan_stages if each.name.startswith("scan_")]
        self._first = len(before)  # track of the first stage of commands
        self._points = dict[int, list[Event]]()  # datagram of a command -> way of its flow
        self._names = [*before, *(each.text for each in loop.budget.stages), IN_FORCE, *others]
        self._lanes: list[list[int]] = [[] for _ in self._names]  # end of each lane [ns]
        self._events = list[Event]()

    def events(self, name: str) -> Iterator[Event]:
        """Yield the events; the process has a `name`."""
        self._show_commands()
        if scans := self._loop.budget.scans:
            self._show_scans(scans)
        for track, at_ns, text in self._loop.marks:
            if self._begin_ns <= at_ns < self._end_ns:
                self._mark(self._names.index(track), at_ns, text)
        for track, begin_ns, end_ns, text in self._loop.phases:
            if begin_ns < self._end_ns and end_ns > begin_ns:
                self._slice(self._names.index(track), begin_ns, end_ns, text)
        yield {"ph": "M", "tid": 0, "name": "process_name", "args": {"name": name}}
        for number, (text, lanes) in enumerate(zip(self._names, self._lanes, strict=True), 1):
            for lane in range(max(len(lanes), 1)):
                track_of = {"ph": "M", "tid": number * LANES + lane}
                yield {**track_of, "name": "thread_name", "args": {"name": f"{number} {text}"}}
                place = {"sort_index": number * LANES + lane}
                yield {**track_of, "name": "thread_sort_index", "args": place}
        yield from sorted(self._events, key=itemgetter("tid", "ts"))

    def _us(self, at_ns: int) -> float:
        """Return a time since the begin of the loop, as the format has it [us]."""
        return (at_ns - self._loop.begin_ns) / 1e3

    def _slice(self, track: int, begin_ns: int, end_ns: int, name: str, **args: Any) -> int:
        """Show what lasts some time on a free lane of a track; return the lane's number."""
        lanes = self._lanes[track]
        free = (lane for lane, busy_ns in enumerate(lanes) if busy_ns <= begin_ns)
        lane = next(free, len(lanes))
        lanes[lane : lane + 1] = [end_ns]
        tid, lasts = (track + 1) * LANES + lane, (end_ns - begin_ns) / 1e3
        shown = {"ph": "X", "tid": tid, "ts": self._us(begin_ns), "dur": lasts, "name": name}
        self._events.append({**shown, "args": args})
        return tid

    def _mark(self, track: int, at_ns: int, name: str) -> None:
        tid, scope = (track + 1) * LANES, "p" if self._names[track] == GUARD else "t"
        self._events.append(
            {"ph": "i", "s": scope, "tid": tid, "ts": self._us(at_ns), "name": name}
        )

    def _show_commands(self) -> None:
        budget = self._loop.budget
        for row in self._rows(budget):
            cuts_ns, ended = budget.ns[:, row].tolist(), str(budget.ended[row])
            if not ended:
                cuts_ns.append(int(self._loop.until_ns[row]))
            number = int(budget.numbers[row])
            self._points[number] = self._show_command(number & COUNTER, cuts_ns, ended)

    def _rows(self, budget: Budget) -> list[int]:
        """Return what a budget has of the time that is shown, in its order."""
        begin_ns = budget.ns[0]
        rows = np.flatnonzero((begin_ns >= self._begin_ns) & (begin_ns < self._end_ns))
        found: list[int] = rows[begin_ns[rows].argsort(kind="stable")].tolist()
        return found

    def _show_command(self, counter: int, cuts_ns: list[int], ended: str) -> list[Event]:
        """Show a command as slices, and as a flow through them; return where the flow passes.

        `ended` is a key of `ENDS`.
        """
        name = f"#{counter}" if ended != "withheld" else "withheld"
        about = {"ended": ENDS[ended]} if ended else {}
        points = self._slices(self._first, cuts_ns, name, **about)
        if ended:
            known = [each for each in cuts_ns if each != UNKNOWN_NS]
            last = self._first + min(len(known), len(cuts_ns) - 1) - 1
            self._mark(last, max(known), f"{name} {ENDS[ended]}")
        self._flow("command", points)
        return points

    def _show_scans(self, scans: Budget) -> None:
        """Show scans as slices, and as flows that end in the slices of their commands."""
        for row in self._rows(scans):
            number, cuts_ns = int(scans.numbers[row]), scans.ns[: self._first + 1, row].tolist()
            points = self._slices(0, cuts_ns, f"scan for #{number & COUNTER}")
            made = self._us(cuts_ns[-1])
            then = (each for each in self._points.get(number, ()) if each["ts"] >= made)
            self._flow("scan", [*points, *islice(then, 1)])

    def _slices(self, first: int, cuts_ns: list[int], name: str, **about: Any) -> list[Event]:
        """Show what is between two cuts each as a slice, from the track `first` on.

        Return the points of a flow through the slices.
        """
        points = list[Event]()
        for track, (begin_ns, end_ns) in enumerate(pairwise(cuts_ns), first):
            if UNKNOWN_NS not in (begin_ns, end_ns) and end_ns > begin_ns:
                tid = self._slice(track, begin_ns, end_ns, name, **about)
                points.append({"tid": tid, "ts": self._us(begin_ns)})
        return points

    def _flow(self, name: str, points: list[Event]) -> None:
        """Join points, at least two, by arrows."""
        if len(points) < 2:
            return
        flow = {"cat": "loop", "name": name, "id": next(self._flows)}
        ends = {"ph": "s"}, *[{"ph": "t"}] * (len(points) - 2), {"ph": "f", "bp": "e"}
        self._events += ({**point, **end, **flow} for point, end in zip(points, ends, strict=True))
