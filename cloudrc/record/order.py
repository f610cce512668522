"""The order of a recording: records of both ends go in, one sequence of rows comes out.

A row is logged at its stamp or, if that lies before the row ahead of it, at that row's time: log
times never fall within an end, so that merging two ends by log time puts both in order. Files and
memory are merged by the same rule and give the same tables.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from operator import itemgetter

from cloudrc.record.schema import Row
from cloudrc.record.topics import rows
from cloudrc.records import Record

FIRST_NS = -(2**63)
"""Earlier than every log time [ns]."""


def logged(records: Iterable[Record], offset_ns: int = 0) -> Iterator[tuple[int, Row]]:
    """Fan one end's records out to rows with their log times.

    Args:
        records: Of one end, oldest first.
        offset_ns: Added to every row's stamp [ns].

    Yields:
        The log time [ns] and the row; the log times never fall.
    """
    latest = FIRST_NS
    for record in records:
        for topic, stamp_ns, values in rows(record):
            stamp_ns += offset_ns
            if stamp_ns > latest:
                latest = stamp_ns
            yield latest, (topic, stamp_ns, values)


def merged(
    world_records: Iterable[Record], cloud_records: Iterable[Record], offset_ns: int = 0
) -> Iterator[tuple[int, Row]]:
    """Put the records of both ends in one order, on world's clock.

    Only the rows' stamps move to world's clock; other stamps inside a row stay on the clock that
    their description names.

    Args:
        world_records: Oldest first, on world's clock.
        cloud_records: Oldest first, on cloud's clock.
        offset_ns: World's clock minus cloud's [ns].

    Yields:
        The log time [ns] and the row; at the same instant world's come first.
    """
    world, cloud = logged(world_records), logged(cloud_records, offset_ns)
    return heapq.merge(world, cloud, key=itemgetter(0))
