"""Follow changes in flight: of a profile's file, of a document in the pod, of the peer's address.

A change of a release's ConfigMap is permanent, but a kubelet may need a minute to copy it to a pod.
So `cloudrc link set` also writes the same files, as one document, into the folder of the route
file. Whichever of ConfigMap and document arrives first takes effect. The second one has the same
number of the change and is ignored.
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
from cloudrc.files import read, version
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import CHANGE_FILE, Change, read_change

if TYPE_CHECKING:
    from cloudrc.link.relay import Address


PROFILE_PERIOD = 0.05
"""Time between two checks of the profile's file [s]."""
PEER_PAUSE = (0.5, 1.0)
"""Shortest and longest pause before the peer's name is resolved again [s]. The pause is random, so
that the links of many releases do not query their name server at the same time.
Source: docs/reference/faults.md, "F19"."""
HANDED_FILE = "asked.json"
"""Name of the document, in the folder of the route file."""
SIZE_MAX = 1_200_000
"""Size limit of the document [bytes]: the content of a ConfigMap plus the overhead of JSON."""
PROFILE = "profile.yaml"
_NAME = re.compile(r"[a-zA-Z0-9_][-._a-zA-Z0-9]{0,252}")
_KNOWN = 64
"""Number of changes that are remembered [1]."""
_REFUSED = "the new profile is refused, the old one stays"


class Loaded(NamedTuple):
    """A profile as read from its file.

    Attributes:
        direction: The direction that this process shapes, in SI units.
        values: Both directions as in the file, without defaults, for people.
        change: The last change of the profile: its number and cause.
    """

    direction: DirectionProfile
    values: dict[str, Any]
    change: Change = Change()


Load = Callable[[Path], Loaded]
"""Function that reads and checks a profile's file; it raises a BadInputError if that fails."""


class ProfileFile:
    """A profile's file that may change.

    Kubernetes mounts a ConfigMap as a folder of links into `..data`. `..data` is also a link, and
    Kubernetes replaces it in one step; then the path leads to another file. A check is a single
    system call, because the process checks 20 times per second and its shaper must not be late.
    """

    def __init__(self, path: Path, load: Load, log: Callable[[str], None]) -> None:
        self._path, self._place = path, str(path)
        self._load, self._log = load, log
        self._seen: object = None

    def first(self) -> Loaded:
        """Read the file at the start; raise a BadInputError if that fails."""
        self._seen = version(self._place)
        return self._read()

    def poll(self) -> Loaded | None:
        """Read the file if it has changed; None if it has not, or if the new profile is refused.

        A refusal is logged. If the file changes during the read, somebody is still writing, and
        the next call reads again.
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
            self._log(f"{_REFUSED}: {refusal}")
        return loaded

    def _read(self) -> Loaded:
        loaded = self._load(self._path)
        try:
            note = self._path.with_name(CHANGE_FILE).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return loaded
        return loaded._replace(change=read_change(note))


class Handed(NamedTuple):
    """A change that `cloudrc link set` writes directly into a pod, as a document.

    Attributes:
        change: Number and cause of the change, as the text of `CHANGE_FILE`.
        files: Name -> text: `profile.yaml` and the traces that it names.
    """

    change: str
    files: dict[str, str]


def write_handed(handed: Handed) -> str:
    """Return the text of a document."""
    return json.dumps(handed._asdict())


def read_handed(text: str) -> Handed:
    """Parse the text of a document.

    Raises:
        ValueError: If the text is no such document, or if a file name could lead to another folder.
    """
    found = json.loads(text)
    try:
        files = {str(name): str(content) for name, content in found["files"].items()}
        handed = Handed(str(found["change"]), files)
    except (TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"not a profile that was handed over: {error}") from error
    if PROFILE not in files or not all(map(_NAME.fullmatch, files)):
        raise ValueError(f"not a profile's files: {', '.join(sorted(files))}")
    return handed


class Profiles:
    """The profile's file and the document: each change takes effect once.

    A document that exists at the start is ignored, because the ConfigMap has the same change.
    """

    def __init__(
        self, profile: Path, document: Path, load: Load, log: Callable[[str], None]
    ) -> None:
        """Follow a profile's file and a document.

        Args:
            profile: The profile's file.
            document: Path of the document; it need not exist.
            load: Reads a profile's file.
            log: Receives a line when a change is refused.
        """
        self._file, self._document = ProfileFile(profile, load, log), document
        self._load, self._log = load, log
        self._seen = version(document, follow=False)
        self._known: OrderedDict[str, dict[str, Any]] = OrderedDict()

    def first(self) -> Loaded:
        """Read the profile at the start; raise a BadInputError if that fails."""
        loaded = self._file.first()
        self._is_known(loaded)
        return loaded

    def poll(self) -> Loaded | None:
        """Return the new profile after a change; None without a change."""
        for source in (self._poll_document, self._file.poll):
            loaded = source()
            if loaded is not None and not self._is_known(loaded):
                return loaded
        return None

    def _poll_document(self) -> Loaded | None:
        """Read the document if it has changed; None if it has not, or if it is refused.

        A refusal is logged. The document must belong to this user: if the sidecar runs as root,
        the pod's other containers share the folder but do not run as root.
        """
        seen = version(self._document, follow=False)
        if seen == self._seen or seen is None:
            return None
        self._seen = seen
        try:
            if self._document.lstat().st_uid != os.geteuid():
                raise ValueError(f"{self._document} belongs to another user")
            handed = read_handed(read(self._document, SIZE_MAX).decode())
            with TemporaryDirectory(prefix="handed-", dir=self._document.parent) as folder:
                for name, text in handed.files.items():
                    (Path(folder) / name).write_text(text, encoding="utf-8")
                loaded = self._load(Path(folder) / PROFILE)
        except (BadInputError, OSError, ValueError) as error:
            self._log(f"{_REFUSED}: {error}")
            return None
        return loaded._replace(change=read_change(handed.change))

    def _is_known(self, loaded: Loaded) -> bool:
        """Remember a change; return whether the same change has arrived before.

        `helm upgrade` changes the profile but keeps the note with the number of the previous
        change. Therefore the values count, too.
        """
        number = loaded.change.number
        if not number:
            return False
        before = self._known.get(number)
        self._known[number] = loaded.values
        if len(self._known) > _KNOWN:
            self._known.popitem(last=False)
        return before == loaded.values


class PeerName:
    """The peer's name, whose address may change.

    While an old and a new pod overlap, a headless Service returns both addresses. The address that
    appeared later belongs to the new pod and is used.

    Attributes:
        failures: Number of failed resolutions.
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
            resolve: Returns the addresses of a name; raises an OSError if there is none.
            log: Receives one line for each change.
        """
        self._name, self._port = peer
        self._resolve, self._log = resolve, log
        self._known: list[str] = []
        self._said = ""
        self.failures = 0

    def poll(self) -> Address | None:
        """Resolve the name once; return None before the first success.

        If a later attempt fails, the known address stays.
        """
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
        """Log a line unless it repeats the last line."""
        what = line.partition(", was")[0]
        if what != self._said:
            self._said = what
            self._log(line)
