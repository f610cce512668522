"""Follow what changes in flight: the profile and the address of the peer.

A change of a release's ConfigMap is permanent, but a kubelet may need a minute to copy it to a pod.
So `cloudrc link set` also writes the same files, as one document, into the folder of the route
file. Whichever of ConfigMap and document arrives first takes effect. Both carry the same number of
the change, so the later one is ignored.
"""

from __future__ import annotations

import json
import os
import re
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
"""Name of the document with a change from `cloudrc link set`, in the folder of the route file."""
SIZE_MAX = 1_200_000
"""Size limit of the document in `HANDED_FILE` [bytes]: a ConfigMap's content as JSON."""
PROFILE = "profile.yaml"
_NAME = re.compile(r"[a-zA-Z0-9_][-._a-zA-Z0-9]{0,252}")
_KNOWN = 64
"""Number of changes that are remembered, to recognise a change that arrives twice."""


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
    """Reads the file of a profile again whenever the file changes.

    Kubernetes mounts a ConfigMap as a folder of links into `..data`, a link that Kubernetes
    replaces in one step; then the path leads to another file. A check is a single system call,
    because the process checks 20 times per second and its shaper must not be late.
    """

    def __init__(self, path: Path, load: Load, log: Callable[[str], None]) -> None:
        self._path, self._load, self._log = path, load, log
        self._seen: object = None

    def first(self) -> Loaded:
        """Read the file at the start; raise a BadInputError if that fails."""
        self._seen = version(self._path)
        return self._read()

    def poll(self) -> Loaded | None:
        """Read the file after a change; None without a change, or if the new profile is refused.

        A refusal is logged. If the file changes during the read, somebody is still writing, and
        the next call reads again.
        """
        seen = version(self._path)
        if seen == self._seen:
            return None
        loaded, refusal = None, ""
        try:
            loaded = self._read()
        except (BadInputError, OSError, ValueError) as error:
            refusal = f"the new profile is refused, the old one stays: {error}"
        if version(self._path) != seen:
            return None
        self._seen = seen
        if refusal:
            self._log(refusal)
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
    """Format a change as the text of the document."""
    return json.dumps(handed._asdict())


def read_handed(text: str) -> Handed:
    """Parse the text of the document.

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


class _HandedFile(ProfileFile):
    """Reads the document that `cloudrc link set` writes into a pod.

    A document that exists at the start is ignored, because the ConfigMap has the same change.
    """

    def __init__(self, path: Path, load: Load, log: Callable[[str], None]) -> None:
        super().__init__(path, load, log)
        self._seen = version(path)

    def _read(self) -> Loaded:
        """Read the document; raise a ValueError if the file belongs to another user.

        If the sidecar runs as root, the pod's other containers share the folder but do not run as
        root.
        """
        if self._path.lstat().st_uid != os.geteuid():
            raise ValueError(f"{self._path} belongs to another user")
        handed = read_handed(read(self._path, SIZE_MAX).decode())
        with TemporaryDirectory(prefix="handed-", dir=self._path.parent) as folder:
            for name, text in handed.files.items():
                (Path(folder) / name).write_text(text, encoding="utf-8")
            loaded = self._load(Path(folder) / PROFILE)
        return loaded._replace(change=read_change(handed.change))


class Profiles:
    """Follows the profile's file and the document with a change; applies each change once."""

    def __init__(
        self, profile: Path, document: Path, load: Load, log: Callable[[str], None]
    ) -> None:
        self._file = ProfileFile(profile, load, log)
        self._sources = _HandedFile(document, load, log), self._file
        self._known: dict[str, dict[str, Any]] = {}

    def first(self) -> Loaded:
        """Read the profile at the start; raise a BadInputError if that fails."""
        loaded = self._file.first()
        self._is_known(loaded)
        return loaded

    def poll(self) -> Loaded | None:
        """Return the new profile after a change; None without a change."""
        for source in self._sources:
            loaded = source.poll()
            if loaded is not None and not self._is_known(loaded):
                return loaded
        return None

    def _is_known(self, loaded: Loaded) -> bool:
        """Remember a change; return whether the same change has arrived before.

        `helm upgrade` changes the profile, but leaves the number of the previous change beside it.
        So equal numbers do not prove equal changes: the contents must be equal, too.
        """
        number = loaded.change.number
        if not number:
            return False
        before, self._known[number] = self._known.get(number), loaded.values
        if len(self._known) > _KNOWN:
            del self._known[next(iter(self._known))]
        return before == loaded.values


class PeerName:
    """Resolves the name of the peer, whose address may change.

    While an old and a new pod overlap, a headless Service returns both addresses. The address that
    appeared later belongs to the new pod and is used.

    Attributes:
        failures: Number of failed resolutions.
    """

    def __init__(
        self, peer: Address, resolve: Callable[[str], Sequence[str]], log: Callable[[str], None]
    ) -> None:
        """Set up; `resolve` returns the addresses of a name or raises an OSError."""
        self._name, self._port = peer
        self._resolve, self._log = resolve, log
        self._known: list[str] = []
        self._said = ""
        self.failures = 0

    def poll(self) -> Address | None:
        """Resolve the name once; None before the first success. Log one line for each change.

        If a later attempt fails, the known address stays.
        """
        before = self._known[-1:]
        try:
            addresses = sorted(self._resolve(self._name))
        except OSError as error:
            self.failures += 1
            keeps = f"keeps {before[0]}" if before else "waits for it"
            said, was = f"cannot be resolved ({error.strerror or error}); {keeps}", ""
        else:
            kept = [address for address in self._known if address in addresses]
            self._known = kept + [address for address in addresses if address not in kept]
            said = f"is {self._known[-1]}"
            was = f", was {before[0]}" if before and before != self._known[-1:] else ""
        if said != self._said:
            self._said = said
            self._log(f"{self._name} {said}{was}")
        return (self._known[-1], self._port) if self._known else None
