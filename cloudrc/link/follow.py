# SPDX-License-Identifier: Apache-2.0

"""Follow changes of a running link: a new profile, or a new address of the other pod (the peer).

In a cluster the ConfigMap is the source of truth. Kubernetes may need a minute to copy it to a
pod. Therefore `cloudrc link set` first sends the same files to the process that shapes the link,
and then writes the ConfigMap. Both contain the number of the change; the link applies the one that
arrives first and ignores the other.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

from cloudrc.base.errors import CloudrcError
from cloudrc.base.files import version
from cloudrc.base.outside.document import write_yaml
from cloudrc.link.profile import DIRECTIONS, summary
from cloudrc.link.profile_file import FILE_KEYS, with_files
from cloudrc.link.start import begin, describe
from cloudrc.link.state import CHANGE_FILE, ChangeFacts, LinkState, publish, read_change, to_text

if TYPE_CHECKING:
    from cloudrc.link.carry.udp import Address
    from cloudrc.link.profile import DirectionProfile, ProfileKeys

PROFILE_PERIOD = 0.05  # time between two checks whether the profile's file has changed [s]
PEER_PAUSE = (0.5, 1.0)
"""Shortest and longest pause before the peer's name is resolved again [s]. The pause is random, so
that the links of many releases do not query their name server at the same time.
Source: docs/reference/faults.md, "F19"."""
PROFILE = "profile.yaml"
_NAME = re.compile(r"[a-zA-Z0-9_][-._a-zA-Z0-9]{0,252}")


class Loaded(NamedTuple):
    """One direction of a link profile, and the content of the profile's file."""

    direction: DirectionProfile  # profile of the direction that this process shapes, in SI units
    values: dict[str, Any]  # content of the file, without defaults, to show to users
    change: ChangeFacts = ChangeFacts()  # the last change of the profile: its number and cause
    start_ns: int = 0  # where the schedule begins [ns]
    note: str = ""  # says so in words; "" at its beginning


def load_way(
    keys: ProfileKeys, way: str, values: dict[str, Any], seed: int, stream: str = ""
) -> Loaded:
    """Read the files of a profile; return its direction `way`, and where its schedule begins.

    `values` are the content of the profile's file. The start depends on `seed` and `stream`.
    """
    both = with_files(keys.uplink), with_files(keys.downlink)
    up, down, start_ns = begin(both, keys.start_s, seed, stream=stream)
    note = describe(keys.start_s, start_ns, (up, down))
    return Loaded(up if way == "uplink" else down, values, start_ns=start_ns, note=note)


def publish_state(
    file: Path, before: LinkState | None, loaded: Loaded, now_ns: int, **facts: Any
) -> LinkState:
    """Write the state of a direction that uses a profile from `now_ns` on [ns]; return it.

    `before` is its state until then. `facts` are the other fields of the state.
    """
    radio = 0.0
    if loaded.direction.radio:
        from cloudrc.link.radio import mean_delay  # here: it needs numpy

        radio = mean_delay(loaded.direction, facts["direction"] == "uplink")
    state = LinkState(
        **facts,
        profile=loaded.values,
        since=datetime.now(UTC).isoformat(timespec="seconds"),
        since_ns=now_ns,
        changes=before.changes + 1 if before else 0,
        change=loaded.change.number,
        cause=loaded.change.cause if before else "",
        asked=summary(loaded.direction, radio),
    )
    publish(to_text(state), file)
    return state


Load = Callable[[Path], Loaded]
"""Function that reads and checks a profile's file; raises a CloudrcError if it is invalid."""


def make_folder(folder: Path, values: Mapping[str, Any]) -> Path:
    """Make the folder of a link on this machine, with a folder per direction; return its profile.

    `values` are the content of the profile.
    """
    for way in DIRECTIONS:
        (folder / way).mkdir(parents=True)
    profile = folder / PROFILE
    profile.write_text(write_yaml(values), encoding="utf-8")
    return profile


def read_handed(text: bytes | str) -> dict[str, str]:
    """Parse the body of a change: name -> text of each file, the new profile among them.

    Raises:
        ValueError: If the text is invalid, or if a file name could lead to another folder.
    """
    files = json.loads(text)
    if not isinstance(files, dict) or PROFILE not in files or not all(map(_NAME.fullmatch, files)):
        raise ValueError("not the files of a profile")
    return files


def _with_names(values: dict[str, Any]) -> dict[str, Any]:
    """Replace the paths of files in a profile by the names of the files."""
    ways = {way: keys for way, keys in values.items() if isinstance(keys, dict)}
    names = {
        way: {key: Path(keys[key]).name for key in FILE_KEYS if keys.get(key)}
        for way, keys in ways.items()
    }
    return values | {way: keys | names[way] for way, keys in ways.items()}


@dataclass
class Profiles:
    """Watches the profile's file for changes, and takes changes that are sent.

    A change that comes both ways is returned once.

    Kubernetes mounts a ConfigMap as symbolic links into `..data`, which is itself a symbolic link.
    For a new version, Kubernetes replaces `..data`, so that the same path leads to another file.
    A check for a change takes only one system call, because it runs 20 times per second.
    """

    file: Path
    load: Load
    log: Callable[[str], None]
    _known: dict[str, dict[str, Any]] = field(default_factory=dict)  # number -> values
    _seen: object = None  # what `version` said about the file

    def first(self) -> Loaded:
        """Read the profile for the first time; raise a CloudrcError if it is invalid."""
        self._seen = version(self.file)
        loaded = self._read_profile(self.file)
        self._known[loaded.change.number] = loaded.values
        return loaded

    def take(self, document: bytes, folder: Path) -> Loaded:
        """Read the files of a change that is sent, with `folder` for temporary files.

        Raise a CloudrcError or a ValueError if the change is invalid.
        """
        files = read_handed(document)
        with TemporaryDirectory(prefix="handed-", dir=folder) as made:
            for name, text in files.items():
                (Path(made) / name).write_text(str(text), encoding="utf-8")
            loaded = self._read_profile(Path(made) / PROFILE)
        if not loaded.change.number:
            raise ValueError("the change has no number")
        self._known[loaded.change.number] = loaded.values
        return loaded

    def poll(self) -> Loaded | None:
        """Return a profile that has been changed since the last call; None if there is none.

        An invalid profile is logged.
        """
        before, self._seen = self._seen, version(self.file)
        if self._seen == before:
            return None
        try:
            loaded = self._read_profile(self.file)
        except (CloudrcError, OSError, ValueError) as error:
            self.log(f"the new profile is refused, the old one stays: {error}")
            return None
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
        loaded = self.load(path)
        try:
            note = path.with_name(CHANGE_FILE).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return loaded
        return loaded._replace(change=read_change(note))


@dataclass
class PeerName:
    """Resolves the name of the other pod, whose address changes when the pod is replaced.

    While an old and a new pod overlap, a headless Service returns the addresses of both pods. The
    address that appeared last belongs to the new pod; this class uses that address. `failures`
    counts failed resolutions.
    """

    peer: Address  # host name and port of the other pod
    resolve: Callable[[str], Sequence[str]]  # returns the addresses of a host name, or OSError
    log: Callable[[str], None]
    failures: int = 0
    _known: list[str] = field(default_factory=list)
    _said: str = ""

    def poll(self) -> Address | None:
        """Resolve the name once and return the peer's address; log each change of the address.

        If the resolution fails, return the last known address; None before the first success.
        """
        name, port = self.peer
        try:
            addresses = sorted(self.resolve(name))
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
            self.log(f"{name} {said}")
        return (self._known[-1], port) if self._known else None
