"""A link that a command runs and `cloudrc link set` changes: its profiles, states and sockets."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path

from cloudrc.config.link_edit import Edit
from cloudrc.config.profile import DIRECTIONS, load_profile
from cloudrc.drivers.link_control import ControlServer
from cloudrc.drivers.local import LINK_FOLDER, link_socket
from cloudrc.link.follow import Loaded, Profiles, make_folder, state_after
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import STATE_FILE, LinkState, publish, to_text
from cloudrc.link.traces import link_profile

Apply = Callable[[str, Loaded, int], None]
"""Function that lets a direction follow a profile, at a time on the monotonic clock [ns]."""
Check = Callable[[DirectionProfile, str], None]
"""Function that raises an error if a direction cannot have a profile."""
Changed = Callable[[LinkState, str], None]
"""Function that gets each new state of a direction, and a sentence for the user if the direction
has changed; "" at the start, and for a change of the other direction."""


class LiveLink:
    """Both directions of a link, whose profile can change.

    Attributes:
        folder: Folder of the states, and of the profile.
        url: URL beside which the sockets are that take changes.
        states: Direction -> its present state; empty before `serve`.
        profiles: Direction -> its present profile.
        origins_ns: Direction -> start of its time line, monotonic clock [ns].
    """

    def __init__(
        self,
        edit: Edit,
        folder: Path,
        url: str,
        reason: str,
        check: Check = lambda profile, name: None,
    ) -> None:
        """Prepare a link with the profile `edit.values`; raise an error if `check` does.

        `folder` gets the state of the link, for `cloudrc link set`, which changes it through the
        sockets beside `url`. `reason` names the command that runs the link.
        """
        self.cause, self._reason, self._check = edit.cause, reason, check
        self.folder, self.url = folder / LINK_FOLDER, url
        file = make_folder(self.folder, edit.values)
        self._files = {
            way: Profiles(file, partial(self._load, way), lambda _: None) for way in DIRECTIONS
        }
        self._loaded = {way: profiles.first() for way, profiles in self._files.items()}
        self.profiles = {way: loaded.direction for way, loaded in self._loaded.items()}
        self.states: dict[str, LinkState] = {}
        self.origins_ns: dict[str, int] = {}
        self._servers: list[ControlServer] = []
        self._changed: Changed = lambda state, news: None

    def serve(
        self,
        queue: Callable[[Callable[[], None]], None],
        apply: Apply,
        changed: Changed,
    ) -> None:
        """Begin the time line, and take changes from now on.

        `queue` gets a function for the thread that carries the packets, which then calls `apply`.
        """
        now_ns, self._changed = time.monotonic_ns(), changed
        for way in DIRECTIONS:
            self.origins_ns[way] = now_ns
            self._publish(way, now_ns)
            take = partial(self._take, way, queue, apply)
            state = partial(self.states.get, way)
            self._servers.append(ControlServer(link_socket(self.url, way), take, state))

    def close(self) -> None:
        """Take no more changes, and remove the states."""
        for server in self._servers:
            server.shutdown()
            server.server_close()
        shutil.rmtree(self.folder, ignore_errors=True)

    def status_page(self) -> str:
        """Return the states of both directions as JSON. Any thread may call this method."""
        return json.dumps({way: asdict(state) for way, state in self.states.items()}) + "\n"

    def _load(self, way: str, path: Path) -> Loaded:
        """Read one direction of a profile's file."""
        profile = load_profile(path)
        values = profile.model_dump(mode="json", exclude_defaults=True)
        direction = link_profile(getattr(profile, way))
        self._check(direction, way)
        return Loaded(direction, values)

    def _take(
        self,
        way: str,
        queue: Callable[[Callable[[], None]], None],
        apply: Apply,
        document: bytes,
    ) -> str:
        """Take a change from `cloudrc link set`; return its number."""
        loaded = self._files[way].take(document, self.folder)

        def change() -> None:
            now_ns = time.monotonic_ns()
            if loaded.change.restart:
                self.origins_ns[way] = now_ns
            self._loaded[way], self.profiles[way] = loaded, loaded.direction
            apply(way, loaded, now_ns)
            self._publish(way, now_ns)

        queue(change)
        return loaded.change.number

    def _publish(self, way: str, now_ns: int) -> None:
        before, loaded = self.states.get(way), self._loaded[way]
        facts = {"shaper": "relay", "reason": self._reason, "mode": "relay", "direction": way}
        origin_ns = self.origins_ns[way]
        state = state_after(before, loaded, now_ns, **facts, origin_ns=origin_ns)
        self.states[way] = state
        publish(to_text(state), self.folder / way / STATE_FILE)
        self._changed(state, _news(before, state, restart=loaded.change.restart))


def _news(before: LinkState | None, after: LinkState, *, restart: bool) -> str:
    """Return a sentence about a change of the direction; "" if it is as before."""
    way = after.direction
    if before is None or not (restart or before.profile.get(way) != after.profile.get(way)):
        return ""
    return f"the {way} has changed: {after.cause}"
