"""Run `cloudrc link set`: change the link during a flight, on this machine or in a cluster."""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any

from cloudrc.cli.cluster_flags import flown_release, release_arguments
from cloudrc.cli.find_run import find_local_run, no_run_error, run_argument
from cloudrc.cli.output import output_argument, print_line, print_result
from cloudrc.cluster.client import ClusterError, Release
from cloudrc.errors import BadInputError, MissingPrerequisiteError, TimedOutError
from cloudrc.text import escape, table

if TYPE_CHECKING:
    from cloudrc.cluster.link import LinkParts
    from cloudrc.config.load import Edit
    from cloudrc.link.state import LinkState

EPILOG = """\
where:
  a run on this machine ('cloudrc up', 'cloudrc run'): found automatically, or
  named by --run
  a release in a cluster: if --context, -n or --release is given, or if there is
  no run on this machine; always with 'kubectl cloudrc link set'
  If several runs fly, or ./runs/latest has ended, name the flight by a flag.

examples:
  cloudrc link set downlink.delay_ms=120 uplink.loss=0.02
  cloudrc link set --profile handover
  cloudrc link set --profile wifi uplink.rate_kbit=400 -n demo

KEY is a key of a direction in a profile file. With --profile, time lines start
anew; single values leave them running. The change is recorded. It lasts until
the next change, the end of the run, or 'helm upgrade'."""
COLUMNS = ("delay_ms", "jitter_ms", "distribution", "loss", "rate_kbit")
"""Keys of a direction that have columns of their own; the column OTHER shows all other keys."""
LOCAL_TIMEOUT = 5.0  # time limit for a local link to apply a change [s]; it needs about 0.2 s


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("settings", nargs="*", metavar="KEY=VALUE", help="uplink.KEY=VALUE or downlink.KEY=VALUE")
    add("--profile", metavar="NAME", help="shipped profile, or a file")
    run_argument(parser)
    output_argument(parser)
    release_arguments(parser)


def execute(options: argparse.Namespace) -> int:
    """Change the link as the flags say, and print the new state of the link."""
    began, number = monotonic(), secrets.token_hex(4)
    from cloudrc.drivers.local import LINK_FOLDER

    if (found := find_local_run(options)) is not None:
        run = found.folder
        edit, states = set_here(run / LINK_FOLDER, options.profile, options.settings, number)
        where = str(run)
        took = monotonic() - began
    else:
        from cloudrc.cluster.link import keep, send

        place = Release(options.context, options.namespace, options.release or "")
        link = _link_of(options, place)
        place = replace(place, name=link.release)
        sent = send(place, link, options.profile, options.settings, number)
        took = monotonic() - began
        keep(place, link, sent)
        where = f"release '{place.name}'{f' {place.where}' if place.namespace else ''}"
        edit, states = sent.edit, sent.states
    for text in edit.notes:
        print_line(f"cloudrc: note: {text}", sys.stderr)
    links = {state.direction: asdict(state) for state in states}
    document = {"change": number, "seconds": round(took, 3), "links": links}
    heads = ("DIRECTION", "SHAPER", "DELAY", "JITTER", "LOSS", "RATE", "OTHER")
    said = escape(f"{where}: in force after {took:.1f} s")
    print_result(options.output, document, f"{table([heads, *map(_row, states)])}\n{said}")
    return 0


def read_states(folder: Path) -> list[LinkState]:
    """Read the states of both directions from the link's folder; [] while there is no link."""
    from cloudrc.config.load import DIRECTIONS
    from cloudrc.link.state import STATE_FILE, from_text

    try:
        return [from_text((folder / way / STATE_FILE).read_text("utf-8")) for way in DIRECTIONS]
    except (OSError, ValueError):
        return []


def set_here(
    folder: Path, profile: str | None, settings: Sequence[str], number: str
) -> tuple[Edit, list[LinkState]]:
    """Pass a profile to a local link; wait until it applies; return the profile and the new states.

    `profile` is the name or file of a profile that replaces the present one; None keeps it.
    `settings` are texts such as "uplink.delay_ms=120". `number` identifies the change.

    Raises:
        BadInputError: If there is no link yet, or if a value cannot be used.
        TimedOutError: If a direction does not apply the change.
    """
    from cloudrc.config.document import Document, write_yaml
    from cloudrc.config.load import edit_profile
    from cloudrc.files import write_atomically
    from cloudrc.link.follow import HANDED_FILE, PROFILE
    from cloudrc.link.state import CHANGE_FILE, ChangeFacts, write_change

    states = read_states(folder)
    if not states:
        raise BadInputError(
            f"{folder.parent}: no link is up there: the flight has not begun or has ended"
        )
    edit = edit_profile(Document(states[0].profile), profile, settings)
    note = write_change(ChangeFacts(number, edit.cause, edit.restart))
    document = json.dumps({CHANGE_FILE: note, PROFILE: write_yaml(edit.values)})
    for state in states:
        write_atomically(folder / state.direction / HANDED_FILE, document.encode())
    deadline = monotonic() + LOCAL_TIMEOUT
    while late := [state.direction for state in states if state.change != number]:
        if monotonic() > deadline:
            logs = " and ".join(str(folder.parent / f"{way}.log") for way in late)
            raise TimedOutError(
                f"the {' and '.join(late)} did not apply the change within {LOCAL_TIMEOUT:g} s; "
                f"see {logs}"
            )
        sleep(0.05)
        states = read_states(folder) or states
    return edit, states


def _link_of(options: argparse.Namespace, where: Release) -> LinkParts:
    from cloudrc.cluster.link import read_link
    from cloudrc.cluster.pods import find_pod

    try:
        return read_link(where)
    except (ClusterError, MissingPrerequisiteError):  # such as kubectl
        try:
            release = flown_release(options)
            for part in ("world", "cloud"):
                find_pod(release, part)  # raises the most precise error
        except MissingPrerequisiteError as error:
            raise no_run_error(options, error, "--run") from None
        raise


def _row(state: LinkState) -> tuple[str, ...]:
    asked, own = state.asked, state.profile.get(state.direction, {})
    delay, jitter, loss, rate = (
        asked.get(key) or 0.0 for key in ("delay", "jitter", "loss", "rate")
    )
    others = (_describe(key, own[key]) for key in own if key not in COLUMNS)
    return (
        state.direction,
        state.shaper,
        f"{delay * 1e3:g} ms",
        f"{jitter * 1e3:g} ms" + (f" {own.get('distribution', 'uniform')}" if jitter else ""),
        f"{loss * 100:.3g} %",
        f"{rate * 1e-3:g} kbit/s" if rate else "-",
        ", ".join(others) or "-",
    )


def _describe(key: str, value: Any) -> str:
    if isinstance(value, list):
        return f"{len(value)} {key}"
    return f"{key} {Path(value).name if isinstance(value, str) else value}"
