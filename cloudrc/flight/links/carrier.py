# SPDX-License-Identifier: Apache-2.0

"""A link that a command runs, that `cloudrc link set` changes, and that is judged at the end."""

from __future__ import annotations

import contextlib
import json
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cloudrc.base.outside.document import Document
from cloudrc.base.outside.refusal import naming
from cloudrc.config.link_edit import edit_profile
from cloudrc.config.profile import DIRECTIONS, load_profile
from cloudrc.flight.folder import new_folder
from cloudrc.flight.local.places import LINK_FOLDER, link_socket, socket_folder
from cloudrc.flight.pod.link_control import ControlServer
from cloudrc.link.carry.engine import Engine, LinkWay
from cloudrc.link.carry.messages import MessageWay
from cloudrc.link.carry.tcp.medium import Medium
from cloudrc.link.follow import Loaded, Profiles, load_way, make_folder, publish_state
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import STATE_FILE, LinkState
from cloudrc.link.verify.packets import Period
from cloudrc.results.under_way import LINK, announced

STEP = 0.05  # longest time until the engine reacts to a change or a signal [s]
Tell = Callable[[str], None]
"""Function that shows a line to the user."""
Follower = LinkWay | Medium | MessageWay
"""What follows the changes of a direction."""
Check = Callable[[DirectionProfile, str], None]
"""Function that raises an error if a direction cannot have a profile."""


@dataclass(frozen=True)
class CarrySettings:
    """What a command asks of its link; a field is the flag of this name."""

    link: str  # name or file of a profile
    settings: Sequence[str]  # changes of the profile: KEY=VALUE
    seed: int


class LiveLink:
    """Both directions of a link, whose profile can change.

    Attributes:
        cause: The profile and its changes in words.
        folder: Folder of the states, and of the profile.
        url: URL beside which the sockets are that take changes.
        states: Direction -> its present state; empty before `serve`.
        origins_ns: Direction -> start of its schedule, monotonic clock [ns].
        ways: Direction -> what happened to its packets; empty before `carry`.
        engine: Carries the packets; None before `serve`.
        unread: Direction -> number of packets that were dropped before the engine has read them.
        export: Gets each new state of a direction.
    """

    def __init__(
        self,
        asked: CarrySettings,
        command: str,
        tell: Tell,
        stack: contextlib.ExitStack,
        *,
        output: Path | None = None,
        flag: str = "-o",
        stream: str = "",
        check: Check = lambda profile, name: None,
    ) -> None:
        """Read the profile of a command's link, and make the folder of its state.

        `output` is a new folder for the link's state, given by `flag`; without it, the state is in
        a temporary folder. `tell` gets notes, and a sentence about each change. `stream` is the
        name of the link, as in `cloudrc.link.open`.

        Raises:
            CloudrcError: If the profile or a setting cannot be used, or if `check` raises one.
        """
        edit = edit_profile(Document({}), asked.link, asked.settings, command)
        for note in edit.notes:
            tell(f"note: {note}")
        base = tempfile.TemporaryDirectory(prefix="cloudrc-", dir=socket_folder())
        sockets = Path(stack.enter_context(base))
        folder = sockets if output is None else new_folder(output, "", flag=flag)
        self.url = f"unix:{sockets}/api.sock"  # as of a run, though nothing listens there
        stack.enter_context(announced(folder, self.url, LINK))
        self.cause, self.seed, self.folder = edit.cause, asked.seed, folder / LINK_FOLDER
        self._stream = stream
        self._reason, self._tell, self._check = f"cloudrc {command}", tell, check
        file = make_folder(self.folder, edit.values)
        self._files = {
            way: Profiles(file, partial(self._load, way), lambda _: None) for way in DIRECTIONS
        }
        self._loaded = {way: profiles.first() for way, profiles in self._files.items()}
        self.states, self.ways = dict[str, LinkState](), dict[str, LinkWay]()
        self.origins_ns, self.unread = dict[str, int](), dict[str, int]()
        self.engine: Engine | None = None
        self.export: Callable[[LinkState], None] = lambda state: None
        self._followers: Mapping[str, Follower] = {}
        self._stack = stack
        stack.callback(shutil.rmtree, self.folder, ignore_errors=True)

    def profile(self, way: str) -> DirectionProfile:
        """Return the present profile of a direction."""
        return self._loaded[way].direction

    def begin(self) -> int:
        """Begin the schedule; return when its time was 0, monotonic clock [ns]."""
        first = self._loaded["uplink"]  # both directions begin at one place
        if first.note:
            self._tell(first.note)
        origin_ns = time.monotonic_ns() - first.start_ns
        self.origins_ns = dict.fromkeys(DIRECTIONS, origin_ns)
        return origin_ns

    def carry(self, gives: Mapping[str, Callable[[Any], bool]]) -> None:
        """Begin the schedule of `ways`; `gives` has a function per direction that hands on."""
        origin_ns = self.begin()
        for way, give in gives.items():
            up, profile = way == "uplink", self.profile(way)
            link = LinkDirection(profile, self.seed, up, origin_ns, stream=self._stream)
            self.ways[way] = LinkWay(link, give)

    def serve(self, engine: Engine, media: Mapping[str, Follower] | None = None) -> None:
        """Take changes from now on, for `media`, else for `ways`; `engine` carries the packets."""
        self.engine, self._followers = engine, media or self.ways
        for way in DIRECTIONS:
            self._publish(way, time.monotonic_ns())
            take, state = partial(self._take, way), partial(self.states.get, way)
            server = ControlServer(link_socket(self.url, way), take, state)
            self._stack.callback(server.close)

    def status_page(self) -> str:
        """Return the states of both directions as JSON. Any thread may call this method."""
        return json.dumps({way: asdict(state) for way, state in self.states.items()}) + "\n"

    def period(self, way: str) -> Period:
        """Return which packets of a direction followed its present profile."""
        first, origin_ns = self.ways[way].first, self.origins_ns[way]
        cuts = isinstance(self._followers.get(way), MessageWay)
        return Period(self.profile(way), self.seed, way == "uplink", first, origin_ns, cuts)

    def counts(self) -> dict[str, int]:
        """Return the number of packets by outcome, and their lateness [ns]."""
        if self.engine is None:
            return {}
        errors = self.engine.errors.in_ns()
        errors.pop("released", None)
        return {**self.engine.counts(), "unread": sum(self.unread.values()), **errors}

    def _load(self, way: str, path: Path) -> Loaded:
        """Read one direction of a profile's file."""
        profile = load_profile(path)
        values = profile.model_dump(mode="json", exclude_defaults=True)
        loaded = load_way(profile, way, values, self.seed, self._stream)
        with naming(way):
            self._check(loaded.direction, way)
        return loaded

    def _take(self, way: str, document: bytes) -> str:
        """Take a change from `cloudrc link set`; return its number."""
        loaded = self._files[way].take(document, self.folder)

        def change() -> None:
            now_ns = time.monotonic_ns()
            restart, start_ns = loaded.change.restart, loaded.start_ns
            if restart:
                self.origins_ns[way] = now_ns - start_ns
            self._loaded[way] = loaded
            if way in self._followers:
                follower = self._followers[way]
                follower.replace_profile(loaded.direction, restart=restart, start_ns=start_ns)
            self._publish(way, now_ns)

        assert self.engine is not None
        self.engine.changes.append(change)
        return loaded.change.number

    def _publish(self, way: str, now_ns: int) -> None:
        """Publish the new state of a direction; tell the user if the direction has changed."""
        before, loaded = self.states.get(way), self._loaded[way]
        state = self.states[way] = publish_state(
            self.folder / way / STATE_FILE,
            before,
            loaded,
            now_ns,
            shaper="relay",
            reason=self._reason,
            mode="relay",
            direction=way,
            origin_ns=self.origins_ns[way],
        )
        self.export(state)
        if before and way in self._followers:
            if loaded.change.restart or before.profile.get(way) != state.profile.get(way):
                self._tell(f"the {way} has changed: {state.cause}")
