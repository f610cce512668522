# SPDX-License-Identifier: Apache-2.0

"""Serve the page that shows and steers a flight, until the flight ends."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import NamedTuple

from cloudrc.base.errors import CloudrcError
from cloudrc.base.outside.paths import lock
from cloudrc.config.load import read_experiment, robot_settings
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.doors.console.feed import FlightFeed
from cloudrc.doors.console.page import Page
from cloudrc.doors.console.pictures import PictureFeed
from cloudrc.doors.console.steering import LinkControl, Steering
from cloudrc.physics.geometry.obstacles import has_surface, obstacles
from cloudrc.teleop.client import Api

SWITCH_PERIOD = 5e-4
"""Time after which a thread of this process lets another one run [s]. With Python's 5 ms, the 90th
percentile of the answers to STOP doubles while 50 pages have the scene."""
RETRY_PERIOD = 0.2
"""Time between two attempts to read the robot's status from the API [s]."""


class ConsoleTarget(NamedTuple):
    """The flight that the console shows and steers."""

    config: Path  # experiment file
    api: Api  # of teleop
    link: LinkControl  # reads and changes the link
    has_ended: Callable[[], bool]
    token: Callable[[], str] | None = None  # of the page; None: a new one, which is printed
    robot: int | None = None  # number in a fleet
    records: Path | None = None  # folder of the sockets of cloud's records; None: no pictures

    def experiment(self) -> ResolvedExperiment:
        """Read the experiment of the robot."""
        return read_experiment(str(self.config), robot_settings(self.robot))


def serve(
    flight: ConsoleTarget, ready: Callable[[Page], None], port: int = 0, origins: Sequence[str] = ()
) -> None:
    """Serve the page of a flight until the flight has ended.

    Args:
        flight: What the page shows and steers.
        ready: Is called with the page once it can be opened.
        port: TCP port on 127.0.0.1; 0: any free port.
        origins: Origins of proxies that serve the page.
    """
    with ExitStack() as opened:
        sys.setswitchinterval(SWITCH_PERIOD)
        text = "this run has a console already; open its page, or end it first"
        lock(opened.enter_context(flight.config.open()), text)
        experiment = flight.experiment()
        known = obstacles(experiment.scene, touch=experiment.mission.touched)
        feed = FlightFeed(tuple(filter(has_surface, known)), experiment.world.files.known_hull)
        steering = Steering(flight.api, flight.link)
        # A proxy reaches a pod at its own address, which the NetworkPolicy guards.
        host = "0.0.0.0" if flight.token and origins else "127.0.0.1"
        page = Page(experiment, feed, steering, port, flight.token, origins, host)
        opened.callback(page.close)
        steering.watch()
        steering.start()
        ready(page)
        pictures = None
        if experiment.camera is not None and flight.records is not None:
            pictures = opened.enter_context(closing(PictureFeed(flight.records)))
        due = 0.0
        while not flight.has_ended():
            with suppress(CloudrcError):  # teleop starts or ends; the page says what is wrong
                for status in flight.api.robot():
                    now = time.monotonic()
                    feed.take(status, now)
                    if pictures is not None and (picture := pictures.take(status)) is not None:
                        page.show_picture(picture)
                    if now >= due:  # drawing takes half of the time: no old statuses queue up
                        page.update(now)
                        due = 2 * time.monotonic() - now
            page.update(time.monotonic())
            time.sleep(RETRY_PERIOD)
