# SPDX-License-Identifier: Apache-2.0

"""Write loops in Chrome's trace format, which Perfetto (ui.perfetto.dev) and Chrome show offline.

Each stage of a command is a slice on a track of the stage, and a flow joins its slices. Slices that
overlap are on tracks of their own, because a viewer would drop one of two on the same track.

Source: "Trace Event Format", Google, 2016; Perfetto, docs/getting-started/other-formats.md.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from itertools import count, pairwise
from operator import itemgetter
from typing import Any

import numpy as np

from cloudrc.metrics.budget import ENDS, UNKNOWN_NS
from cloudrc.timeline.loops import GUARD, MISSION, Loop

IN_FORCE = "command in force"
"""Name of the track behind the last stage."""
LANES = 1000
"""Largest number of tracks of a stage."""
Event = dict[str, Any]


def write_trace(loops: Mapping[str, Loop], begin: float, end: float) -> bytes:
    """Return the content of a trace file of loops, by the names of their robots.

    It has what began from `begin` to `end` [s since the begin of each].
    """
    flows, events = count(1), list[Event]()
    for process, (name, loop) in enumerate(loops.items(), start=1):
        span_ns = loop.begin_ns + round(begin * 1e9), loop.begin_ns + round(end * 1e9)
        tracks = _Tracks(loop, span_ns, flows)
        events += ({"pid": process, **each} for each in tracks.events(name))
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
        self._names = [*(each.text for each in loop.budget.stages), IN_FORCE, *others]
        self._lanes: list[list[int]] = [[] for _ in self._names]  # end of each lane [ns]
        self._events = list[Event]()

    def events(self, name: str) -> Iterator[Event]:
        """Yield the events; the process has a `name`."""
        self._show_commands()
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
        begin_ns = budget.ns[0]
        rows = np.flatnonzero((begin_ns >= self._begin_ns) & (begin_ns < self._end_ns))
        for row in rows[begin_ns[rows].argsort(kind="stable")].tolist():
            cuts_ns, ended = budget.ns[:, row].tolist(), str(budget.ended[row])
            if not ended:
                cuts_ns.append(int(self._loop.until_ns[row]))
            self._show_command(int(budget.numbers[row]) & 0xFFFFFFFF, cuts_ns, ended)

    def _show_command(self, counter: int, cuts_ns: list[int], ended: str) -> None:
        """Show a command as slices, and as a flow through them; `ended` is a key of `ENDS`."""
        name = f"#{counter}" if ended != "withheld" else "withheld"
        about = {"ended": ENDS[ended]} if ended else {}
        points, at_ns = list[Event](), cuts_ns[0]
        for track, (begin_ns, end_ns) in enumerate(pairwise(cuts_ns)):
            if UNKNOWN_NS not in (begin_ns, end_ns) and end_ns > begin_ns:
                tid, at_ns = self._slice(track, begin_ns, end_ns, name, **about), end_ns
                points.append({"ph": "t", "tid": tid, "ts": self._us(begin_ns)})
        if ended:
            known = sum(each != UNKNOWN_NS for each in cuts_ns)
            self._mark(min(known, len(cuts_ns) - 1) - 1, at_ns, f"{name} {ENDS[ended]}")
        if len(points) > 1:
            points[0]["ph"], points[-1]["ph"], points[-1]["bp"] = "s", "f", "e"
            flow = {"cat": "loop", "name": "command", "id": next(self._flows)}
            self._events += ({**point, **flow} for point in points)
