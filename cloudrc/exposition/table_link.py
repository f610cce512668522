"""The metrics of the emulated link: who shapes it, what was asked for, what became of datagrams."""

from __future__ import annotations

from cloudrc.exposition.labels import (
    DIRECTIONS,
    LINK,
    LINK_MODES,
    LINK_OUTCOMES,
    RELEASE_PERCENTILES,
    SHAPERS,
    STEP_PERCENTILES,
)
from cloudrc.exposition.metric import Kind, Metric, counter, gauge

LINKS = (
    Metric(
        "cloudrc_link_info",
        Kind.GAUGE,
        "1; its labels say who shapes a direction of the link, and which mode was asked for.",
        (LINK,),
        {"shaper": SHAPERS, "direction": DIRECTIONS, "mode": LINK_MODES},
    ),
    gauge(
        "cloudrc_link_delay_seconds",
        "Mean one-way delay that the profile in force asks for.",
        (LINK,),
        direction=DIRECTIONS,
    ),
    gauge(
        "cloudrc_link_step_lateness_seconds",
        "How late netem's qdisc took the last 10,000 steps of its time line; absent without steps.",
        (LINK,),
        percentile=tuple(STEP_PERCENTILES),
    ),
    counter(
        "cloudrc_link_datagrams_total",
        "Datagrams at the shaper by what became of them.",
        (LINK,),
        outcome=LINK_OUTCOMES,
    ),
    counter(
        "cloudrc_link_restored_total",
        "How often another hand had removed or changed netem's qdisc, and it was put back.",
        (LINK,),
    ),
    gauge(
        "cloudrc_link_release_error_seconds",
        "How late datagrams left the relay in the last 10 s; absent with netem.",
        (LINK,),
        percentile=tuple(RELEASE_PERCENTILES),
    ),
    counter(
        "cloudrc_link_released_early_total",
        "Datagrams that left the relay before they were due: none, unless its code is wrong; absent"
        " with netem.",
        (LINK,),
    ),
    counter(
        "cloudrc_dns_errors_total",
        "Times that the peer's name could not be resolved; the last address known is kept.",
        (LINK,),
    ),
)
"""A part of the table."""
