"""What both ends record of the link between them: the link's part of the table of topics."""

from __future__ import annotations

from cloudrc import records as rec
from cloudrc.record.schema import Field, Topic

LINK_TOPICS = (
    Topic(
        "/link",
        "cloudrc_msgs/msg/LinkChanged",
        rec.LinkChanged,
        "either",
        "What shapes what this end sends was seen first, has changed or is told again, in real time"
        " only, clock of its end",
        (
            Field("uplink", "bool", "", "true for the uplink, false for the downlink"),
            Field("shaper", "string", "", "relay or netem"),
            Field("cause", "string", "", "why it changed; empty if it is as it came up"),
            Field("age", "float", "s", "it had been in force for so long"),
            Field("time_line", "float", "s", "its time line had run for so long; NaN: as before"),
            Field("delay", "float", "s", "asked for at the time line's beginning, one way"),
            Field("jitter", "float", "s", "likewise"),
            Field("loss", "float", "1", "likewise, in the long run"),
            Field("rate", "float", "bit/s", "likewise; NaN without a bottleneck"),
            Field("conditions", "string", "", "all that is asked for, as JSON"),
        ),
    ),
    Topic(
        "/link_check",
        "cloudrc_msgs/msg/LinkChecked",
        rec.LinkChecked,
        "either",
        "One number of the link that this end hears, judged in flight, in real time only, clock of"
        " its end",
        (
            Field("uplink", "bool", "", "true for the uplink, false for the downlink"),
            Field("quantity", "string", "", "mean, deviation, variation, round_trip, loss..."),
            Field("asked", "float", "s or 1", "what a true link shows: a delay, or a share"),
            Field("measured", "float", "s or 1", "likewise"),
            Field("low", "float", "s or 1", "least that is believed, likewise"),
            Field("high", "float", "s or 1", "most that is believed, likewise"),
            Field(
                "verdict",
                "string",
                "",
                "ok, off, open where there were too few to say; told judges nothing",
            ),
            Field("datagrams", "int", "", "that this rests on"),
        ),
    ),
)
"""Topics whose records drivers make."""
