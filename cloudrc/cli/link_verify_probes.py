"""What a probe of the link looks like: its header over and over, so that damage to it is seen.

A link may be asked to flip bits. Whichever bit it is, most copies of the header are whole: they say
which probe it was, and that it is not as it was sent.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from cloudrc.link.verify.judge import SIZE
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import HEADER_SIZE, Direction

PROBE, TRAIN = 254, 255
"""Kinds that no end of a tunnel knows: these datagrams never leave this process's own link."""
EPOCH = 1


class Probes:
    """Writes and reads the probes of both directions.

    Attributes:
        damaged: Numbers of those that arrived, but not as they were sent, by direction.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        """Set up for probes of these sizes, UDP payload [bytes], by direction."""
        self._sizes = {way: {PROBE: size, TRAIN: SIZE} for way, size in sizes.items()}
        self.damaged: dict[str, set[int]] = {way: set() for way in sizes}

    def write(self, way: str, kind: int, number: int) -> bytes:
        """Make a probe."""
        header = codec.encode_header(kind, Direction[way.upper()], EPOCH, number)
        return _filled(header, self._sizes[way][kind])

    def read(self, data: bytes) -> tuple[int, int, int]:
        """Read kind, epoch and number, whichever bit was flipped; note whether any was.

        Raises:
            ValueError: If it is none of ours.
        """
        header = data[:HEADER_SIZE]
        whole = data == _filled(header, len(data))
        if not whole:
            places = range(0, len(data) - HEADER_SIZE + 1, HEADER_SIZE)
            copies = Counter(data[place : place + HEADER_SIZE] for place in places)
            if not copies:
                raise ValueError("too short")
            header = copies.most_common(1)[0][0]
        found = codec.peek(header)
        if not whole and found[0] == PROBE:
            self.damaged[Direction(header[1]).name.lower()].add(found[2])
        return found


def _filled(header: bytes, size: int) -> bytes:
    return (header * (size // HEADER_SIZE + 1))[:size]
