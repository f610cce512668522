"""What a pod's sidecar follows in flight: the file of its profile, and the address of its peer.

Both are asked again and again by threads of their own, since a file has to be parsed and a name
server may be slow. Here they are plain objects: file and names in, changes out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.files import version
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import CHANGE_FILE, Change, read_change

if TYPE_CHECKING:
    from cloudrc.link.relay_lane import Address

PROFILE_PERIOD = 0.05
"""How often the profile's file is looked at [s]."""
PEER_PAUSE = (0.5, 1.0)
"""Shortest and longest pause until the peer's name is resolved again [s]: it is random, so that the
links of many releases do not ask their name server at once.
Source: docs/reference/faults.md, "F19"."""


class Loaded(NamedTuple):
    """A profile as it was read: one direction in SI, and the file's values for people.

    Attributes:
        direction: The one that is shaped here.
        values: Both, as in the file, defaults left out.
        change: Who changed it last, and why.
    """

    direction: DirectionProfile
    values: dict[str, Any]
    change: Change = Change()


Load = Callable[[Path], Loaded]
"""Reads and checks a profile's file; raises a BadInputError."""


class ProfileFile:
    """A profile's file that may change.

    Kubernetes mounts a ConfigMap as a folder of links to `..data`, itself a link, which it swaps in
    one step: the file behind the path is another one then. A look is one system call, since there
    are twenty a second beside a shaper that must not be late.
    """

    def __init__(self, path: Path, load: Load, log: Callable[[str], None]) -> None:
        self._path, self._place = path, str(path)
        self._load = load
        self._log = log
        self._seen: object = None

    def first(self) -> Loaded:
        """Read the file; raises a BadInputError."""
        self._seen = version(self._place)
        return self._read()

    def poll(self) -> Loaded | None:
        """Read the file if it has changed; None if not, or if it is refused, which is logged.

        A file that changes while it is read is being written, and is read again: half of it may
        be valid, too, and the whole would be a second change.
        """
        seen = version(self._place)
        if seen == self._seen:
            return None
        loaded, refusal = None, ""
        try:
            loaded = self._read()
        except (BadInputError, OSError) as error:
            refusal = str(error)
        if version(self._place) != seen:
            return None
        self._seen = seen
        if refusal:
            self._log(f"the new profile is refused, the old one stays: {refusal}")
        return loaded

    def _read(self) -> Loaded:
        loaded = self._load(self._path)
        try:
            told = self._path.with_name(CHANGE_FILE).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return loaded
        return loaded._replace(change=read_change(told))


class PeerName:
    """The peer's name, whose address may change.

    While an old and a new pod overlap a headless Service names both: the one that came later is the
    one that flies on.

    Attributes:
        failures: How often it could not be resolved.
    """

    def __init__(
        self,
        peer: Address,
        resolve: Callable[[str], Sequence[str]],
        log: Callable[[str], None],
    ) -> None:
        """Set up.

        Args:
            peer: Name or address, and port.
            resolve: Gives the addresses of a name; raises an OSError if there is none.
            log: Gets one line for each change.
        """
        self._name, self._port = peer
        self._resolve = resolve
        self._log = log
        self._known: list[str] = []
        self._said = ""
        self.failures = 0

    def poll(self) -> Address | None:
        """Resolve the name once; None if that fails and never succeeded before."""
        before = self._known[-1:]
        try:
            addresses = sorted(self._resolve(self._name))
        except OSError as error:
            self.failures += 1
            keeps = f"keeps {before[0]}" if before else "waits for it"
            self._say(f"{self._name} cannot be resolved ({error.strerror or error}); {keeps}")
        else:
            kept = [address for address in self._known if address in addresses]
            self._known = kept + [address for address in addresses if address not in kept]
            was = f", was {before[0]}" if before and before != self._known[-1:] else ""
            self._say(f"{self._name} is {self._known[-1]}{was}")
        return (self._known[-1], self._port) if self._known else None

    def _say(self, line: str) -> None:
        """Log a line unless it says what the last one said."""
        what = line.partition(", was")[0]
        if what != self._said:
            self._said = what
            self._log(line)
