"""What a pod's sidecar follows in flight: the file of its profile, and the address of its peer.

Both are asked again and again by threads of their own, since a file has to be parsed and a name
server may be slow. Here they are plain objects: file and names in, changes out.

A profile that `cloudrc link set` hands to a pod's sidecar at once: a document in, a profile out.

A change of the ConfigMap lasts, but a kubelet may take a minute to bring it here. So the same files
are put beside the route as well, and whichever comes first takes force; the other one is known.
"""

from __future__ import annotations

import json
import os
import re
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.files import version
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import CHANGE_FILE, Change, read_change

if TYPE_CHECKING:
    from cloudrc.link.relay import Address


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


HANDED_FILE = "asked.json"
"""Name of the document, beside the route."""
SIZE_MAX = 1_200_000
"""Of the document [bytes]: what a ConfigMap takes, and what JSON adds."""
PROFILE = "profile.yaml"
_NAME = re.compile(r"[a-zA-Z0-9_][-._a-zA-Z0-9]{0,252}")
_KNOWN = 64


class Handed(NamedTuple):
    """What is handed over.

    Attributes:
        change: Who changed the profile, and why, as the text of the file beside it.
        after: Number of the change that the ConfigMap told of before; "" if of none.
        files: Name to text: `profile.yaml` and the traces that it names.
    """

    change: str
    after: str
    files: dict[str, str]


def write_handed(handed: Handed) -> str:
    """Write the document."""
    return json.dumps(handed._asdict())


def read_handed(text: str) -> Handed:
    """Read the document.

    Raises:
        ValueError: If it is none, or names a file that could lie elsewhere.
    """
    found = json.loads(text)
    try:
        files = {str(name): str(content) for name, content in found["files"].items()}
        handed = Handed(str(found["change"]), str(found["after"]), files)
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a profile that was handed over: {error}") from error
    strange = [name for name in files if not _NAME.fullmatch(name)]
    if strange or PROFILE not in files:
        raise ValueError(f"not a profile's files: {', '.join(sorted(files))}")
    return handed


class HandedProfile:
    """The document, which may be there at any time.

    Only what this user has written counts: where the sidecar is root, the pod's other containers
    are not, and share the folder.
    """

    def __init__(self, path: Path, load: Load, log: Callable[[str], None]) -> None:
        self._path, self._load, self._log = str(path), load, log
        self._seen: object = None

    def first(self, change: Change) -> Loaded | None:
        """Read what an earlier process was handed, if the ConfigMap here is as it was before."""
        self._seen = version(self._path, follow=False)
        if self._seen is None:
            return None
        handed = self._open()
        return self._unpack(handed) if handed and handed.after == change.number else None

    def poll(self) -> Loaded | None:
        """Read the document if it is another one; None if not, or if it is refused: logged."""
        seen = version(self._path, follow=False)
        if seen == self._seen or seen is None:
            return None
        self._seen = seen
        handed = self._open()
        return self._unpack(handed) if handed else None

    def _open(self) -> Handed | None:
        try:
            name = os.open(self._path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
            with open(name, "rb") as file:
                if os.fstat(name).st_uid != os.geteuid():
                    raise ValueError("it is somebody else's")
                text = file.read(SIZE_MAX + 1)
            if len(text) > SIZE_MAX:
                raise ValueError("it is too long")
            return read_handed(text.decode())
        except (OSError, ValueError) as error:
            self._log(f"what was handed over in {self._path} is refused: {error}")
            return None

    def _unpack(self, handed: Handed) -> Loaded | None:
        try:
            with TemporaryDirectory(prefix="handed-", dir=Path(self._path).parent) as folder:
                for name, text in handed.files.items():
                    (Path(folder) / name).write_text(text, encoding="utf-8")
                loaded = self._load(Path(folder) / PROFILE)
        except (BadInputError, OSError) as error:
            self._log(f"the new profile is refused, the old one stays: {error}")
            return None
        return loaded._replace(change=read_change(handed.change))


class Profiles:
    """The profile's file and what is handed over: each change is taken over once."""

    def __init__(self, file: ProfileFile, handed: HandedProfile) -> None:
        self._file, self._handed = file, handed
        self._known: OrderedDict[str, dict[str, Any]] = OrderedDict()

    def first(self) -> Loaded:
        """Read what holds at the start; raises a BadInputError."""
        lasting = self._file.first()
        loaded = self._handed.first(lasting.change) or lasting
        for one in (lasting, loaded):
            self._is_known(one)
        return loaded

    def poll(self) -> Loaded | None:
        """Read what has changed; None if nothing has."""
        for source in (self._handed, self._file):
            loaded = source.poll()
            if loaded is not None and not self._is_known(loaded):
                return loaded
        return None

    def _is_known(self, loaded: Loaded) -> bool:
        """Whether a change has come by the other way; notes it.

        An upgrade leaves the note of who changed the profile before it: then the values differ.
        """
        number = loaded.change.number
        if not number:
            return False
        before = self._known.get(number)
        self._known[number] = loaded.values
        if len(self._known) > _KNOWN:
            self._known.popitem(last=False)
        return before == loaded.values
