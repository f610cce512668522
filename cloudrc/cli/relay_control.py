"""The relay of local mode follows what `cloudrc link set` leaves in a folder, and tells its state.

    DIR/profile.json, change.json    what is asked for; not there before the first change
    DIR/uplink.json, downlink.json   what is in force (`cloudrc/link/state.py`)
    DIR/uplink.released...           how late its datagrams left so far, every other second

Files are read and written by a thread of its own; the relay's loop only swaps the conditions.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.cli.link_run import loader
from cloudrc.cli.output import say
from cloudrc.link.follow import PROFILE_PERIOD, Loaded, ProfileFile
from cloudrc.link.model import LinkDirection
from cloudrc.link.state import RELEASED_SUFFIX, LinkState, publish, summary, to_text

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.relay import Relay

PROFILE_FILE = "profile.json"
RELEASED_PERIOD = 2.0
"""Between two tellings of how late datagrams left [s]: as often as an end notes it."""


def controlled(
    stop: Callable[[], bool],
    folder: Path,
    experiment: ResolvedExperiment,
    links: tuple[LinkDirection, LinkDirection],
    exporter: Exporter | None,
    relay: Relay,
) -> Callable[[], bool]:
    """Make of `stop`, which a relay asks all the time, one that follows a folder as well.

    Args:
        stop: Whether to end.
        folder: Where to look, and to tell.
        experiment: What the relay began with.
        links: Its uplink and downlink.
        exporter: Shows what is asked for; None if nobody does.
        relay: Takes in what has come before it changes, and says how late it is.
    """
    from cloudrc.assembly import link_profile

    ways = {"uplink": experiment.uplink, "downlink": experiment.downlink}
    values = {way: d.model_dump(mode="json", exclude_defaults=True) for way, d in ways.items()}
    control = RelayControl(
        folder,
        dict(zip(ways, links, strict=True)),
        {way: Loaded(link_profile(direction), values) for way, direction in ways.items()},
        exporter.asked if exporter else lambda direction, delay: None,
        relay.take_in,
        relay.released,
    )
    control.start()
    return control.stop_after(stop)


class RelayControl:
    """Both directions of a relay, and the folder from which they are set."""

    def __init__(
        self,
        folder: Path,
        links: dict[str, LinkDirection],
        first: dict[str, Loaded],
        asked: Callable[[str, float], None] = lambda direction, delay: None,
        take_in: Callable[[], None] = lambda: None,
        released: Callable[[str], dict[str, int]] = lambda way: {},
    ) -> None:
        """Tell what is in force from the start.

        Args:
            folder: Made if it is not there.
            links: "uplink" and "downlink".
            first: What they were made with.
            asked: Learns the mean delay [s] that a direction is asked to have from now on.
            take_in: Puts on the link what has come, before it changes.
            released: Says how late the datagrams of a direction left so far.
        """
        self._folder, self._links, self._asked, self._take_in = folder, links, asked, take_in
        self._released, self._told = released, 0.0
        folder.mkdir(exist_ok=True)
        file = folder / PROFILE_FILE
        self._files = {way: ProfileFile(file, loader(way), _log) for way in links}
        self._wanted: deque[tuple[str, Loaded]] = deque()
        self._done: deque[tuple[str, Loaded, int]] = deque()
        self._changes = dict.fromkeys(links, -1)
        for way, loaded in first.items():
            self._tell(way, loaded, time.monotonic_ns())

    def start(self) -> None:
        """Begin to follow the folder."""
        threading.Thread(target=self._follow, name="link control", daemon=True).start()

    def swap(self) -> None:
        """Put what is asked for in force; the relay's loop calls it between datagrams."""
        self._take_in()
        while self._wanted:
            way, loaded = self._wanted.popleft()
            self._links[way].replace_profile(loaded.direction, restart=loaded.change.restart)
            self._done.append((way, loaded, time.monotonic_ns()))

    def stop_after(self, stop: Callable[[], bool]) -> Callable[[], bool]:
        """Make of `stop`, which the relay asks all the time, one that swaps as well."""

        def ask() -> bool:
            if self._wanted:
                self.swap()
            return stop()

        return ask

    def look(self) -> None:
        """Look once for a change, and tell of those that are in force."""
        for way, file in self._files.items():
            if (loaded := file.poll()) is not None:
                self._wanted.append((way, loaded))
        with suppress(OSError):  # a full disk: what is not told is told at the next look
            self._tell_all()

    def _tell_all(self) -> None:
        while self._done:
            self._tell(*self._done[0])
            self._done.popleft()
        if time.monotonic() - self._told >= RELEASED_PERIOD:
            self._told = time.monotonic()
            for way in self._links:
                if released := self._released(way):
                    publish(self._folder / f"{way}{RELEASED_SUFFIX}", json.dumps(released))

    def _follow(self) -> None:
        while True:
            self.look()
            time.sleep(PROFILE_PERIOD / 2 if self._wanted else PROFILE_PERIOD)

    def _tell(self, way: str, loaded: Loaded, since_ns: int) -> None:
        changes = self._changes[way] + 1
        values: dict[str, Any] = loaded.values
        asked = summary(loaded.direction)
        state = LinkState(
            shaper="relay",
            reason="local mode",
            mode="relay",
            direction=way,
            profile=values,
            since=datetime.now(UTC).isoformat(timespec="seconds"),
            since_ns=since_ns,
            changes=changes,
            change=loaded.change.number,
            cause=loaded.change.cause if changes else "",
            asked=asked,
            # A time line that came up with the link counts from its first datagram.
            origin_ns=since_ns if changes and loaded.change.restart else None,
        )
        self._asked(way, asked["delay"] or 0.0)
        publish(self._folder / f"{way}.json", to_text(state))
        self._changes[way] = changes


def _log(line: str) -> None:
    say(f"cloudrc relay: {line}", sys.stderr)
