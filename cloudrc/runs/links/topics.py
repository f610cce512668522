"""Relay the messages of a topic of ROS 2 over the emulated link, until a signal."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.bridges.ros2 import require_ros
from cloudrc.config.load import edit_profile
from cloudrc.link.exec.verdict import Period
from cloudrc.link.follow import Loaded
from cloudrc.link.model import LinkDirection
from cloudrc.link.relay import ask_for_fifo, settle, tighten_slack
from cloudrc.link.state import LinkState
from cloudrc.outside.document import Document
from cloudrc.runs.links.live import LiveLink
from cloudrc.runs.links.programs import link_folder
from cloudrc.runs.links.programs_report import Carried, make_link_report, write_report
from cloudrc.runs.verify import Report

if TYPE_CHECKING:
    from cloudrc.bridges.ros2.relay import TopicRelay

STEP = 0.05  # longest time until the relay reacts to a change or a signal [s]
LOOK_PERIOD = 2.0  # time between two looks at the nodes of others, which take 1 ms [s]


@dataclass(frozen=True)
class TopicSettings:
    """What to relay; a field is the flag of this name."""

    source: str  # topic, the flag --from
    to: str  # topic
    reliable: bool  # publish RELIABLE
    direction: str  # "uplink" or "downlink"
    link: str  # name or file of a profile
    settings: Sequence[str]  # changes of the profile: KEY=VALUE
    seed: int
    stream: str  # name of the link
    out: Path | None  # folder for the report and the recording


def relay_topic(settings: TopicSettings, tell: Callable[[str], None]) -> Report:
    """Relay messages until KeyboardInterrupt; return the verdict on the link.

    Raises:
        BadInputError: If the profile or a topic cannot be used.
        MissingPrerequisiteError: If there is no ROS 2, or if it does not have the type.
    """
    edit = edit_profile(Document({}), settings.link, settings.settings, "relay ros")
    for note in edit.notes:
        tell(f"note: {note}")
    require_ros("relay ros", "relay", "rclpy")
    from cloudrc.bridges.ros2.relay import TopicRelay

    with contextlib.ExitStack() as stack:
        relay = TopicRelay(settings.source, settings.to)
        stack.callback(relay.close)
        folder, url = link_folder(settings.out, stack, "--out")
        live = LiveLink(edit, folder, url, "cloudrc relay ros")
        stack.callback(live.close)
        relay.wait(tell)
        link = _TopicLink(relay, live, settings)
        quality = link.start(tell)
        settle()
        tighten_slack()
        ask_for_fifo()
        tell(
            f"{relay.source} ({relay.kind}) leads to {relay.target}; link: {live.cause}, "
            f"{settings.direction}, seed {settings.seed}; QoS {quality}"
        )
        with contextlib.suppress(KeyboardInterrupt):
            link.run(tell)
        report = {
            **make_link_report(link),
            "from": relay.source,
            "to": relay.target,
            "type": relay.kind,
        }
        if settings.out:
            write_report(settings.out, report, link)
        return report


class _TopicLink:
    """One direction of a link, which carries messages."""

    def __init__(self, relay: TopicRelay, live: LiveLink, settings: TopicSettings) -> None:
        self.live, self.seed = live, settings.seed
        self._relay, self._settings = relay, settings
        self._first = 0  # number of the first message since the last change
        self._changes = list[Callable[[], None]]()

    def start(self, tell: Callable[[str], None]) -> str:
        """Begin the time line, and hear the topic; return the QoS of both topics in words."""
        way, seed = self._settings.direction, self.seed

        def changed(state: LinkState, news: str) -> None:
            if news and state.direction == way:
                tell(news)

        self.live.serve(self._changes.append, self._follow, changed)
        profile, origin_ns = self.live.profiles[way], self.live.origins_ns[way]
        stream = self._settings.stream
        link = LinkDirection(profile, seed, way == "uplink", origin_ns, stream=stream)
        return self._relay.open(link, reliable=self._settings.reliable)

    def run(self, tell: Callable[[str], None]) -> None:
        """Carry messages for ever."""
        told, looked = set[str](), time.monotonic()
        while True:
            while self._changes:
                self._changes.pop(0)()
            self._relay.step(STEP)
            if time.monotonic() - looked > LOOK_PERIOD:
                looked = time.monotonic()
                for text in self._relay.problems():
                    if text not in told:
                        told.add(text)
                        tell(f"note: {text}")

    def _follow(self, way: str, loaded: Loaded, now_ns: int) -> None:
        """Use another profile from the next message on."""
        if way == self._settings.direction:
            self._relay.link.replace_profile(loaded.direction, restart=loaded.change.restart)
            self._first = self._relay.received

    @property
    def ways(self) -> Mapping[str, Carried]:
        """Direction -> what happened to its packets."""
        return {self._settings.direction: self._relay}

    @property
    def unread(self) -> Mapping[str, int]:
        """Direction -> number of packets that the relay has not read: ROS does not count them."""
        return {self._settings.direction: 0}

    def period(self, name: str) -> Period:
        """Return which messages followed the present profile."""
        profile, origin_ns = self.live.profiles[name], self.live.origins_ns[name]
        return Period(profile, self.seed, name == "uplink", self._first, origin_ns)

    def counts(self) -> dict[str, int]:
        """Return the number of messages by outcome, and how late they were published [ns]."""
        relay, errors = self._relay, self._relay.errors.in_ns()
        errors.pop("released", None)
        return {
            "received": relay.received,
            "forwarded": relay.forwarded,
            "lost": relay.queue.lost,
            "overflow": relay.queue.overflow,
            **errors,
        }
