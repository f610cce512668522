"""Follow changes of a running link: a new profile, or a new address of the other pod (the peer).

`cloudrc link set` changes the release's ConfigMap, so that the change is permanent. Kubernetes may
need a minute to copy the ConfigMap to a pod. Therefore the command also writes the same files, as
one JSON document, into the pod. ConfigMap and document contain the number of the change; the link
applies the one that arrives first and ignores the other.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.files import read, version
from cloudrc.link.state import CHANGE_FILE, ChangeFacts, parse, read_change

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.link.profile import DirectionProfile
    from cloudrc.link.relay import Address

PROFILE_PERIOD = 0.05  # time between two checks whether the profile's file has changed [s]
PEER_PAUSE = (0.5, 1.0)
"""Shortest and longest pause before the peer's name is resolved again [s]. The pause is random, so
that the links of many releases do not query their name server at the same time.
Source: docs/reference/faults.md, "F19"."""
HANDED_FILE = "asked.json"
"""JSON document of `cloudrc link set`, beside the route file: the files of a change, name -> text.
The files are `PROFILE`, the traces that it names, and `CHANGE_FILE`."""
SIZE_MAX = 1_200_000  # size limit of the JSON document [bytes]: room for the content of a ConfigMap
PROFILE = "profile.yaml"
_NAME = re.compile(r"[a-zA-Z0-9_][-._a-zA-Z0-9]{0,252}")


class Loaded(NamedTuple):
    """One direction of a link profile, and the content of the profile's file."""

    direction: DirectionProfile  # profile of the direction that this process shapes, in SI units
    values: dict[str, Any]  # content of the file, without defaults, to show to users
    change: ChangeFacts = ChangeFacts()  # the last change of the profile: its number and cause


Load = Callable[[Path], Loaded]
"""Function that reads and checks a profile's file; raises a BadInputError if it is invalid."""


def prepare_link(folder: Path, link: ResolvedExperiment) -> None:
    """Make the folder of a link on this machine, with its profile and a folder per direction."""
    from cloudrc.config.document import write_yaml
    from cloudrc.config.load import DIRECTIONS
    from cloudrc.config.schema import Profile

    for way in DIRECTIONS:
        (folder / way).mkdir(parents=True)
    profile = Profile(uplink=link.uplink, downlink=link.downlink)
    text = write_yaml(profile.model_dump(mode="json", exclude_defaults=True))
    (folder / PROFILE).write_text(text, encoding="utf-8")


def read_handed(text: bytes | str) -> dict[str, str]:
    """Parse the JSON document of a change: name -> text of each file beside the new profile.

    Raises:
        ValueError: If the text is invalid, or if a file name could lead to another folder.
    """
    files = parse(dict[str, str], text)
    if PROFILE not in files or not all(map(_NAME.fullmatch, files)):
        raise ValueError(f"not a profile's files: {', '.join(sorted(files))}")
    return files


def _with_names(values: dict[str, Any]) -> dict[str, Any]:
    """Replace the paths of files in a profile by the names of the files."""
    ways = {way: keys for way, keys in values.items() if isinstance(keys, dict)}
    names = {
        way: {key: Path(keys[key]).name for key in ("trace", "table") if keys.get(key)}
        for way, keys in ways.items()
    }
    return values | {way: keys | names[way] for way, keys in ways.items()}


class Profiles:
    """Watches two files for changes: the profile's, and the one that `cloudrc link set` writes.

    A change that reaches both files is returned once.

    Kubernetes mounts a ConfigMap as symbolic links into `..data`, which is itself a symbolic link.
    For a new version, Kubernetes replaces `..data`, so that the same path leads to another file.
    A check for a change takes only one system call per file, because it runs 20 times per second.
    """

    def __init__(
        self, profile: Path, document: Path, load: Load, log: Callable[[str], None]
    ) -> None:
        """Watch the file `profile`, and `document`, the file that `cloudrc link set` writes.

        A document that exists already is ignored: in a pod, the ConfigMap contains its change.
        """
        self._profile, self._load, self._log = profile, load, log
        self._readers = {document: self._read_document, profile: self._read_profile}
        self._seen = {path: version(path) for path in self._readers}
        self._known: dict[str, dict[str, Any]] = {}

    def first(self) -> Loaded:
        """Read the profile for the first time; raise a BadInputError if it is invalid."""
        self._seen[self._profile] = version(self._profile)
        loaded = self._read_profile(self._profile)
        self._known[loaded.change.number] = loaded.values
        return loaded

    def poll(self) -> Loaded | None:
        """Return a profile that has been changed since the last call; None if there is none.

        An invalid profile is logged.
        """
        for path, read_file in self._readers.items():
            before, self._seen[path] = self._seen[path], version(path)
            if self._seen[path] == before:
                continue
            try:
                loaded = read_file(path)
            except (BadInputError, OSError, ValueError) as error:
                self._log(f"the new profile is refused, the old one stays: {error}")
                continue
            number = loaded.change.number
            known = self._known.get(number) if number else None
            self._known[number] = loaded.values
            if known is None:
                return loaded
            if _with_names(known) != _with_names(loaded.values):
                # `helm upgrade` keeps the number of the previous change.
                return loaded._replace(change=ChangeFacts())
            if known != loaded.values:  # the same files in another folder, which stays
                return loaded._replace(change=replace(loaded.change, restart=False))
        return None

    def _read_profile(self, path: Path) -> Loaded:
        loaded = self._load(path)
        try:
            note = path.with_name(CHANGE_FILE).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return loaded
        return loaded._replace(change=read_change(note))

    def _read_document(self, path: Path) -> Loaded:
        """Read the document; raise a ValueError if the file belongs to another user.

        All containers of the pod can write to the folder, but only the sidecar may run as root. So
        a sidecar that runs as root follows only changes that root has made.
        """
        if path.lstat().st_uid != os.geteuid():
            raise ValueError(f"{path} belongs to another user")
        files = read_handed(read(path, SIZE_MAX))
        with TemporaryDirectory(prefix="handed-", dir=path.parent) as folder:
            for name, text in files.items():
                (Path(folder) / name).write_text(text, encoding="utf-8")
            return self._read_profile(Path(folder) / PROFILE)


class PeerName:
    """Resolves the name of the other pod, whose address changes when the pod is replaced.

    While an old and a new pod overlap, a headless Service returns the addresses of both pods. The
    address that appeared last belongs to the new pod; this class uses that address. `failures`
    counts failed resolutions.
    """

    def __init__(
        self, peer: Address, resolve: Callable[[str], Sequence[str]], log: Callable[[str], None]
    ) -> None:
        """Set `peer`, host name and port of the other pod; do not resolve the name yet.

        `resolve` returns the addresses of a host name or raises an OSError; `log` writes one line.
        """
        self._name, self._port = peer
        self._resolve, self._log = resolve, log
        self._known: list[str] = []
        self._said = ""
        self.failures = 0

    def poll(self) -> Address | None:
        """Resolve the name once and return the peer's address; log each change of the address.

        If the resolution fails, return the last known address; None before the first success.
        """
        try:
            addresses = sorted(self._resolve(self._name))
        except OSError as error:
            self.failures += 1
            keeps = "its last address stays" if self._known else "the link waits"
            said = f"cannot be resolved ({error.strerror or error}); {keeps}"
        else:
            kept = [address for address in self._known if address in addresses]
            self._known = kept + [address for address in addresses if address not in kept]
            said = f"is {self._known[-1]}"
        if said != self._said:
            self._said = said
            self._log(f"{self._name} {said}")
        return (self._known[-1], self._port) if self._known else None
