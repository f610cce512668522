"""The records of the link itself: that it was changed, and what its standing check finds out."""

from __future__ import annotations

from typing import NamedTuple


class LinkChanged(NamedTuple):
    """Driver, in real time only: what shapes what this end sends is new. Topic /link.

    World tells of the uplink, cloud of the downlink. Noted when the link is first seen, when it
    has changed, and again when a session or a mission begins.

    Attributes:
        stamp_ns: When this end noted it [ns], own clock.
        uplink: True for the uplink, False for the downlink.
        shaper: "relay" or "netem".
        cause: Why it changed, in words; "" if it is as it came up.
        age: How long it had been in force by then [s].
        time_line: How long its time line had been running by then [s]; NaN: as the one before.
        delay: Asked for, one way [s]; this and the following at the beginning of the time line.
        jitter: Asked for, as in the profile [s].
        loss: Asked for, in the long run, in [0, 1].
        rate: Asked for [bit/s]; NaN without a bottleneck.
        conditions: All that is asked for, as in a profile's file, as JSON.
    """

    stamp_ns: int
    uplink: bool
    shaper: str
    cause: str
    age: float
    time_line: float
    delay: float
    jitter: float
    loss: float
    rate: float
    conditions: str


class LinkChecked(NamedTuple):
    """Driver, in real time only: one number of the link, judged in flight. Topic /link_check.

    Cloud judges the uplink, world the downlink, by the tunnel's own datagrams of up to 250 s.

    Attributes:
        stamp_ns: [ns], own clock.
        uplink: True for the uplink, False for the downlink.
        quantity: "mean", "deviation", "variation", "middle", "round_trip", "loss", "reordered" or
            "duplicated". And what is only told: "datagrams" (needed, there), "time_line" (share
            of it that was watched and as asked), "rate" (not measured by datagrams that come
            alone), "jitter_share" (usual, and by which share the jitter may be off here),
            "correlation" (asked of netem, which realises none), and "mean_takes" and the like (so
            many datagrams as there never are would decide it).
        asked: What a true link shows: delays [s], shares in [0, 1].
        measured: Likewise.
        low: Least that is believed, likewise.
        high: Most that is believed, likewise.
        verdict: "ok", "off", or "open" where there were too few datagrams to say, or the ends
            woke so late that the link cannot be told from them; "told" judges nothing.
        datagrams: That this rests on.
    """

    stamp_ns: int
    uplink: bool
    quantity: str
    asked: float
    measured: float
    low: float
    high: float
    verdict: str
    datagrams: int
