"""The part of the table of metrics that is the standing check of the link."""

from __future__ import annotations

from cloudrc.exposition.labels import DIRECTIONS, ENDS
from cloudrc.exposition.metric import gauge

CHECK = (
    gauge(
        "cloudrc_link_believed",
        "1 if the direction that this end hears is proven to be what was asked for, 0 if it is"
        " not (/link.json of the same port says why); absent while there are too few datagrams to"
        " say.",
        ENDS,
        direction=DIRECTIONS,
    ),
)
"""Entries of the table."""
