"""A profile that `cloudrc link set` hands to a pod's sidecar at once: a document in, a profile out.

A change of the ConfigMap lasts, but a kubelet may take a minute to bring it here. So the same files
are put beside the route as well, and whichever comes first takes force; the other one is known.
"""

from __future__ import annotations

import json
import os
import re
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError
from cloudrc.files import version
from cloudrc.link.sidecar_follow import Load, Loaded, ProfileFile
from cloudrc.link.state import Change, read_change

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
