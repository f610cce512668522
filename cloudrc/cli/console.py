"""Run `cloudrc console`: serve a page in the browser that shows a flight and steers it."""

from __future__ import annotations

import argparse
import io
import secrets
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, redirect_stdout
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from cloudrc.cli.client import UNIX, Api
from cloudrc.cli.extras import require
from cloudrc.cli.find_run import find_local_run
from cloudrc.cli.output import print_line
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.console.steering import Link

EPILOG = """\
examples:
  cloudrc console
  cloudrc console runs/hover-local-seed1 --port 8080

The page is served on this machine only. The first browser steers; others read.
Keys: arrows fly along x and y, W and S up and down, while they are held; Space
holds; Shift+X stops the rotors."""
PERIOD = 0.04
"""Longest wait for the next datagram of the flight [s]."""
LOOK_PERIOD = 1.0
"""Time between two looks whether the flight goes on [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    about = "folder of the flying run (default: ./runs/latest, else the only one)"
    parser.add_argument("run", nargs="?", type=Path, metavar="RUN", help=about)
    port = "port of the page on 127.0.0.1 (default: any free port)"
    parser.add_argument("--port", type=int, default=0, metavar="N", help=port)
    parser.set_defaults(context=None, namespace=None, release=None)


def execute(options: argparse.Namespace) -> int:
    """Serve the page until the flight ends or the user interrupts."""
    require("the console", ("console", "world"))
    found = find_local_run(options, lambda run, api: (run, api), "no run flies there")
    if found is None:
        raise BadInputError("no run flies here; start one: cloudrc run --mode local")
    (run, url), out = found, sys.stdout
    run = run.resolve()
    if not url:
        raise BadInputError(f"{run} flies without an API; the console needs one")
    with ExitStack() as opened:
        opened.enter_context(redirect_stdout(io.StringIO()))  # viser prints about itself
        _serve(options.port, run, url, opened, out)
    print_line("the flight has ended", sys.stderr)
    return 0


def _serve(port: int, run: Path, url: str, opened: ExitStack, out: TextIO) -> None:
    from cloudrc.console.page import Page

    page = Page(port)
    opened.callback(page.close)
    from cloudrc.drivers.tap import TAP_FILE, TapListener

    tap = TapListener(Path(url.removeprefix(UNIX)).with_name(TAP_FILE), page.url)
    opened.callback(tap.close)
    print_line(f"console: {page.url}", out)
    from cloudrc.config.load import read_experiment
    from cloudrc.console.feed import FlightFeed
    from cloudrc.console.steering import Steering
    from cloudrc.drivers.local import under_way
    from cloudrc.geometry.scene import load_scene

    experiment = read_experiment(str(run / "config.yaml"))
    feed = FlightFeed(load_scene(experiment.world.scene))
    steering = Steering(Api(url), _local_link(run))
    steering.watch()
    steering.start()
    page.fill(experiment, feed, steering)
    looked = time.monotonic()
    while True:
        records = tap.receive(PERIOD)
        now = time.monotonic()
        feed.take(records, now)
        page.update(now)
        if now - looked > LOOK_PERIOD:
            looked = now
            if under_way().get(run) != url:
                return


def _local_link(run: Path) -> Link:
    """Return the way to the link of a run on this machine."""
    from cloudrc.cli.link_set import read_states, set_here
    from cloudrc.console.steering import Link
    from cloudrc.drivers.local import LINK_FOLDER

    folder = run / LINK_FOLDER

    def read() -> dict[str, float]:
        found: dict[str, float] = {}
        for state in read_states(folder):
            delay, jitter, loss = (state.asked.get(k) or 0.0 for k in ("delay", "jitter", "loss"))
            values = {"delay_ms": delay * 1e3, "jitter_ms": jitter * 1e3, "loss": loss}
            found |= {f"{state.direction}.{key}": value for key, value in values.items()}
        return found

    def change(settings: Sequence[str]) -> None:
        set_here(folder, None, settings, secrets.token_hex(4))

    return Link(read, change)
