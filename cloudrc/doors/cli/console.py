# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc console`: serve a page in the browser that shows a flight and steers it."""

from __future__ import annotations

import argparse
from pathlib import Path
from secrets import token_hex
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import BadInputError, CloudrcError, InterruptedRunError
from cloudrc.doors.cli.output import open_page, print_line, tell
from cloudrc.doors.cli.parser import Options, Parser, whole_number
from cloudrc.doors.cli.where import (
    api_arguments,
    flown_release,
    given_token,
    need_run_here,
    release_arguments,
    run_argument,
)
from cloudrc.teleop.client import UNIX, Api

if TYPE_CHECKING:
    from cloudrc.doors.console.page import Page
    from cloudrc.doors.console.serve import ConsoleTarget

EPILOG = """\
examples:
  cloudrc console
  cloudrc console runs/hover-local-seed1 --port 8080 --no-open
  cloudrc console --cluster -n demo      a release with console.enabled=true
  cloudrc console my-release             the same, by the name of the release
  cloudrc console --allow-origin https://hub.example.org     behind a proxy

The page is served on this machine only; the printed address has its token. The
first browser steers, the others read; every page has STOP. Keys: arrows fly
along x and y, W and S up and down, while they are held; Space holds; Shift+X
switches it off. No key turns the robot: it keeps its heading."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "folder of the flying run (default: the only run in flight), or a release"
    parser.add_argument("target", nargs="?", type=Path, metavar="RUN|RELEASE", help=about)
    run_argument(parser)
    about = "port of the page on 127.0.0.1 (default: any free port)"
    parser.add_argument("--port", type=whole_number(0, 65_535), default=0, metavar="N", help=about)
    about = "show the page of a release, and carry out its changes of the link until Ctrl-C"
    parser.add_argument("--cluster", action="store_true", help=about)
    parser.add_argument(
        "--no-open", action="store_true", help="print the page's address, open no browser"
    )
    about = "origin of a proxy that serves the page, such as https://hub.example.org; repeatable"
    parser.add_argument(
        "--allow-origin", action="append", type=_origin, default=[], metavar="ORIGIN", help=about
    )
    release_arguments(parser)
    pod = parser.add_argument_group("in the container of the chart")
    pod.add_argument("--config", type=Path, metavar="FILE", help="experiment file")
    pod.add_argument("--profile", type=Path, metavar="FILE", help="file of the link profile")
    about = "folder of 'cloudrc process cloud --records DIR', for the pictures of a camera"
    pod.add_argument("--records", type=Path, metavar="DIR", help=about)
    api_arguments(pod, "the API of teleop")


def _origin(text: str) -> str:
    from cloudrc.doors.console.access import ORIGIN

    if ORIGIN.fullmatch(text) is None:
        about = "give scheme and host as the browser shows them, such as https://hub.example.org"
        raise argparse.ArgumentTypeError(f"'{text}' is no origin; {about}")
    return text


def execute(options: Options) -> int:
    """Serve the page until the flight ends or the user interrupts."""
    run: Path | None = options.target
    options.run = options.run or run
    if run and len(run.parts) == 1 and not (run.exists() or options.release):
        tell(f"no folder '{run}' here: looking for a release")
        options.run, options.release = None, str(run)
    if options.cluster or options.context or options.namespace or options.release:
        return _show_release(options)
    flight = _in_pod(options) if options.config else _local(options)
    from cloudrc.doors.console.serve import serve

    def ready(page: Page) -> None:
        if flight.token:  # the log of a pod is read by many
            print_line(f"console: port {page.port}; to open it: cloudrc console --cluster")
        else:
            print_line(f"console: {page.url}")
        if not (options.no_open or options.config):
            open_page(page.url)

    serve(flight, ready, options.port, options.allow_origin)
    tell("the flight has ended")
    return 0


def _local(options: Options) -> ConsoleTarget:
    from cloudrc.doors.console.serve import ConsoleTarget
    from cloudrc.doors.console.steering import LinkControl
    from cloudrc.flight.links.change import read_states, set_here
    from cloudrc.flight.local.places import LINK_FOLDER
    from cloudrc.results.under_way import under_way

    found = need_run_here(options.run)
    run, url = found.folder.resolve(), found.url

    def read() -> dict[str, Any]:
        states = read_states(run / LINK_FOLDER)
        return states[0].profile if states else {}

    link = LinkControl(
        read, lambda settings: set_here(run / LINK_FOLDER, url, None, settings, token_hex(4))
    )
    return ConsoleTarget(
        run / "config.yaml",
        Api(url),
        link,
        lambda: under_way().get(run) != url,
        records=Path(url.removeprefix(UNIX)).parent if url.startswith(UNIX) else None,
    )


def _in_pod(options: Options) -> ConsoleTarget:
    if not (options.api and options.profile):
        raise BadInputError("--config is for the chart's container: give --api and --profile, too")
    from cloudrc.doors.console.in_pod import flight_of_pod

    token = given_token(options)
    flight = flight_of_pod(options.config, options.profile, options.api, token, print_line)
    return flight._replace(robot=options.robot, records=options.records)


def _show_release(options: Options) -> int:
    """Forward a release's console page to this machine; apply link changes made on the page."""
    if options.run:
        raise BadInputError("RUN names a run here, the other flags a cluster; give one")
    if options.allow_origin:
        raise BadInputError("--allow-origin: not with a release, whose page no proxy serves")
    release = flown_release(options)
    from cloudrc.cluster.link import keep, read_link, send
    from cloudrc.cluster.pods import follow_page, operator_token
    from cloudrc.doors.console.access import PARAMETER, page_token
    from cloudrc.doors.console.in_pod import LINK_SET

    def ready(address: str) -> None:
        given = given_token(options)
        operator = given() if given else operator_token(release)
        url = f"{address}/?{PARAMETER}={page_token(operator)}"
        print_line(f"console: {url}")
        if not options.no_open:
            open_page(url)

    for line in follow_page(release, options.port, ready):
        if not line.startswith(LINK_SET):
            continue
        try:
            link, settings = read_link(release), line.removeprefix(LINK_SET).split()
            keep(release, link, send(release, link, None, settings, token_hex(4)))
            print_line(line)
        except CloudrcError as error:
            tell(f"{line}: {error}")
    raise InterruptedRunError("the container 'console' has ended; see its log")
