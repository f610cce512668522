"""A link that changes over time, judged without its draws: where on its time line it is, is known.

As `link verify` judges one: delays about what is asked at that time, losses stretch by stretch.
"""

from __future__ import annotations

import numpy as np

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_estimate import frame_of
from cloudrc.link.verify_expect import Schedule, as_sent, expect
from cloudrc.link.verify_judge import Row, judge
from cloudrc.link.verify_measure import Log, measure
from cloudrc.link.verify_netem import netem_makes
from cloudrc.link.verify_plan import Plan, stretches_of
from cloudrc.link.verify_twin_rows import Pairs

_BATCHES = 384


def judge_story(profile: DirectionProfile, pairs: Pairs, size: int) -> list[Row]:
    """Judge datagrams of a link that changes, as netem makes it; takes some 100 ms.

    Args:
        profile: What is asked, with its time line.
        pairs: What was heard, and when since the time line began it was sent.
        size: Of each, UDP payload [bytes].
    """
    profile, count = netem_makes(profile), len(pairs.sent)
    period = float(pairs.sent[-1] - pairs.sent[0]) / (count - 1)
    schedule = Schedule(period, count, size, float(pairs.sent[0]))
    expects = expect(profile, schedule, batches=_BATCHES)
    expects = as_sent(expects, profile, np.maximum.accumulate(pairs.sent), size)
    stretches = tuple(stretches_of(profile, schedule))
    plan = Plan(profile, schedule, expects, stretches, expects.needs())
    measured = measure(_log(pairs), expects.over_time, frame=frame_of(profile, pairs.sent))
    return [row for row in judge(plan, measured) if row.name != "corrupted"]


def _log(pairs: Pairs) -> Log:
    """Write down when what was sent and arrived, to whole nanoseconds."""
    sent_ns = np.rint(pairs.sent * 1e9).astype(np.int64)
    delay_ns = np.rint(np.where(pairs.arrived, pairs.heard, 0.0) * 1e9).astype(np.int64)
    arrivals = [
        (place, int(sent_ns[place] + delay_ns[place]))
        for place in np.flatnonzero(pairs.arrived).tolist()
        for _ in range(int(pairs.copies[place]))
    ]
    return Log(sent_ns.tolist(), arrivals)
