"""A bottleneck that serves packets at recorded instants, as mahimahi replays a cellular link.

At each opportunity 1500 bytes may leave. What a packet leaves over serves the packets that wait
behind it; an opportunity for which no packet waits is lost.

Source: R. Netravali et al., "Mahimahi: accurate record-and-replay for HTTP", USENIX ATC 2015.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

from cloudrc.errors import BadInputError
from cloudrc.files import version
from cloudrc.outside.paths import read_file
from cloudrc.outside.refusal import naming
from cloudrc.outside.values import InvalidValueError, Quantity

BYTES = 1500
"""What may leave at an opportunity [bytes]."""
SUFFIXES = {".up": "uplink", ".down": "downlink"}
"""End of the name of a file that mahimahi has recorded -> its direction."""
_SIZE_MAX = 64 << 20  # size limit of a file [bytes]
_TIME = Quantity("ms", ge=0, le=1e9, whole=True)


def read_opportunities(path: Path, size_max: int = _SIZE_MAX) -> tuple[int, ...]:
    """Read the times of the opportunities [ns]; an unchanged file is read once.

    Raises:
        BadInputError: If the file cannot be read, or if its times do not rise.
    """
    return _read(path, size_max, version(path))


@lru_cache(maxsize=4)
def _read(path: Path, size_max: int, state: object) -> tuple[int, ...]:
    """Read a file; `state` changes with it."""
    name, times = f"rate_trace {path}", list[int]()
    data = read_file(path, name, "give a file of mahimahi: a line per packet, in ms", size_max)
    for number, line in enumerate(data.decode("utf-8", "replace").splitlines(), 1):
        with naming(f"{name}, line {number}"):
            time = _TIME.read(line)
            if times and time < times[-1]:
                raise InvalidValueError(f"{time} ms comes before {times[-1]} ms")
        times.append(time)
    if not times or not times[-1]:
        raise BadInputError(f"{name}: its last line is its period in ms, and must be above 0")
    return tuple(time * 1_000_000 for time in times)


class Opportunities:
    """Says when packets leave a bottleneck, in the order of their arrival."""

    def __init__(self, times_ns: Sequence[int]) -> None:
        """Begin with all opportunities, at `times_ns` and then again after the last one."""
        self._times_ns, self._period_ns = times_ns, times_ns[-1]
        self._place = -1  # of the opportunity at which the last packet left, counted from the first
        self._left = 0  # what may still leave there [bytes]

    def leave_ns(self, size: int, now_ns: int) -> int:
        """Return when a packet of `size` bytes leaves that arrives at `now_ns` of the time line."""
        passes, rest_ns = divmod(now_ns, self._period_ns)
        first = passes * len(self._times_ns) + bisect_left(self._times_ns, rest_ns)
        if first > self._place:
            self._place, self._left = first, BYTES
        while size > self._left:
            size -= self._left
            self._place, self._left = self._place + 1, BYTES
        self._left -= size
        passes, place = divmod(self._place, len(self._times_ns))
        return passes * self._period_ns + self._times_ns[place]
