# SPDX-License-Identifier: Apache-2.0

"""Tell how far a counter of world, cloud or link rose in a part of a recording.

Counters count from the start of their process, so that a session's counters go on from mission to
mission. They are recorded once a second or less often; those of cloud also as a mission begins and
ends.
"""

from __future__ import annotations

import numpy as np

from cloudrc.results.record.columns import Recording

APART = 1.0
"""Time between two records of a counter [s]. So long before its first record, a counter was 0."""


def growth(
    recording: Recording,
    name: str,
    span_ns: tuple[int, int] | None,
    *,
    end: str | None = None,
    steady: bool = False,
) -> float | None:
    """Return by how much a counter rose in a time [1], to the nearest integer.

    Between two records, a counter is taken to rise evenly. If a total is below the one before, the
    process has restarted and counts from 0. A counter without a record before this time counts from
    0, and after its last record it no longer rises. A `steady` counter rises before its first and
    after its last record, too, as on average between them.

    Args:
        recording: The recording.
        name: Name of the counter.
        span_ns: Begin and end of the time [ns], world's clock; None means the whole recording.
        end: Process of the counter, such as "world"; None if only one process has the counter.
        steady: Whether something is counted that happens all the time, such as datagrams.

    Returns:
        None if the counter was not recorded, or if a steady one was recorded only once.
    """
    count = recording["/count"]
    rows = (count["name"] == name) & (True if end is None else count["end"] == end)
    stamps, totals = count["stamp_ns"][rows], count["total"][rows]
    if not len(stamps) or (steady and stamps[0] == stamps[-1]):
        return None
    grown = np.diff(totals)
    sums = totals[0] + np.cumsum([0, *np.where(grown < 0, totals[1:], grown)])
    if span_ns is None:
        return float(sums[-1])
    at = (stamps - stamps[0]) * 1e-9
    if steady:
        more = (sums[-1] - sums[0]) / at[-1] * APART
        at, sums = [-APART, *at, at[-1] + APART], [sums[0] - more, *sums, sums[-1] + more]
    elif stamps[0] > span_ns[0]:
        at, sums = [-APART, *at], [0.0, *sums]
    before, after = np.interp((np.array(span_ns) - stamps[0]) * 1e-9, at, sums)
    return float(np.rint(after - before))
