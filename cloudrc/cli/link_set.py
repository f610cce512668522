"""Run `cloudrc link set`: change the link during a flight, on this machine or in a cluster."""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any

from cloudrc.cli.cluster_flags import release_arguments, release_from_flags
from cloudrc.cli.find_run import find_local_run, link_folder_of, no_run_error, run_argument
from cloudrc.cli.output import format_document, output_argument, print_line
from cloudrc.cluster.client import DEFAULT_RELEASE, ClusterError, Release
from cloudrc.errors import BadInputError, CloudrcError, MissingPrerequisiteError, TimedOutError

if TYPE_CHECKING:
    from cloudrc.cluster.link import LinkParts, Sent
    from cloudrc.config.profile_edit import Edit
    from cloudrc.link.state import LinkState

EPILOG = """\
where:
  a run on this machine ('cloudrc run --mode local'): found automatically, or
  named by --run
  a release in a cluster: if --context, -n or --release is given, or if no run
  flies on this machine; always with 'kubectl cloudrc link set'

examples:
  cloudrc link set downlink.delay_ms=120 uplink.loss=0.02
  cloudrc link set --profile handover
  cloudrc link set --profile wifi uplink.rate_kbit=400 -n demo

KEY is a key of a direction in a profile file. With --profile, time lines start
anew; single values leave them running. The change is recorded. It lasts until
the next change, the end of the run, or 'helm upgrade'."""
LOCAL_TIMEOUT = 5.0
"""Time limit for a local relay to apply a change [s]; a relay needs about 0.2 s."""
POLL_PERIOD = 0.05
"""Pause between two reads of the link's state [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="uplink.KEY=VALUE or downlink.KEY=VALUE"
    )
    parser.add_argument("--profile", metavar="NAME", help="shipped profile, or a file")
    run_argument(parser)
    output_argument(parser)
    release_arguments(parser)


def execute(options: argparse.Namespace) -> int:
    """Change the link and print its new state."""
    began, number = monotonic(), secrets.token_hex(4)
    folder = find_local_run(options, link_folder_of, "no run flies there")
    if folder is not None:
        edit, states = _set_here(options, folder, number)
        took = monotonic() - began
    else:
        place = Release(options.context, options.namespace, options.release or DEFAULT_RELEASE)
        link, sent = _set_in_cluster(options, place, number)
        took = monotonic() - began
        from cloudrc.cluster.link import keep

        keep(place, link, sent)
        edit, states = sent.edit, sent.states
    for note in edit.notes:
        print_line(f"cloudrc: note: {note}", sys.stderr)
    if options.output != "table":
        print(format_document(_document(states, number, took), options.output))
    else:
        _show(states, took)
    return 0


def _set_here(
    options: argparse.Namespace, folder: Path, number: str
) -> tuple[Edit, list[LinkState]]:
    """Write a new profile into the relay's folder, and wait until the relay has applied it.

    Raises:
        BadInputError: If the request is not valid.
        TimedOutError: If the relay does not apply the profile in time.
    """
    from cloudrc.config.document import Document
    from cloudrc.config.profile_edit import DIRECTIONS, edit_profile
    from cloudrc.link.state import CHANGE_FILE, PROFILE_FILE, from_text, publish

    def look() -> list[LinkState]:
        try:
            texts = [(folder / f"{way}.json").read_text("utf-8") for way in DIRECTIONS]
            return [from_text(text) for text in texts]
        except (OSError, ValueError):
            return []

    states = look()
    if not states:
        raise BadInputError(f"{folder.parent}: no link is up there (yet); wait for the start")
    edit = edit_profile(Document(states[0].profile), options.profile, options.settings)
    publish(folder / CHANGE_FILE, _note(edit, number))
    publish(folder / PROFILE_FILE, json.dumps(edit.values, indent=2) + "\n")
    deadline = monotonic() + LOCAL_TIMEOUT
    while not (states := look()) or any(state.change != number for state in states):
        if monotonic() > deadline:
            late = [s.direction for s in states if s.change != number] or ["link"]
            raise TimedOutError(
                f"the {' and '.join(late)} did not apply the change within {LOCAL_TIMEOUT:g} s; "
                f"see {folder.parent / 'relay.log'}"
            )
        sleep(POLL_PERIOD)
    return edit, states


def _set_in_cluster(
    options: argparse.Namespace, place: Release, number: str
) -> tuple[LinkParts, Sent]:
    """Send a new profile to both link containers."""
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        looking = pool.submit(_link_of, options, place)
        # Import while the cluster answers: a change should be in force within a second.
        from cloudrc.cluster.link import send
        from cloudrc.config.profile_edit import check_edit

        if looking.exception() is not None:
            check_edit(options.profile, options.settings)  # report a wrong command line first
        link = looking.result()
    note = partial(_note, number=number)
    return link, send(place, link, options.profile, options.settings, note)


def _link_of(options: argparse.Namespace, where: Release) -> LinkParts:
    """Read the link of the release; if the release has none, raise an error with the reason."""
    from cloudrc.cluster.link import read_link

    failed: CloudrcError
    try:
        found = read_link(where)
        failed = ClusterError(
            f"release '{where.name}' has no link to change; is it a release of cloudrc? see: "
            "helm list --all-namespaces"
        )
    except (ClusterError, MissingPrerequisiteError) as error:  # or kubectl is missing
        found, failed = None, error
    if found is not None:
        return found
    from cloudrc.cluster.pods import find_pod

    try:
        release = release_from_flags(options)
        for part in ("world", "cloud"):
            find_pod(release, part)  # raises the most precise error
    except MissingPrerequisiteError as error:
        raise no_run_error(options, error, "--run") from None
    raise failed


def _note(edit: Edit, number: str) -> str:
    """Return the text of `CHANGE_FILE`: number, cause and restart of the change."""
    return json.dumps({"number": number, "cause": edit.cause, "restart": edit.restart}) + "\n"


def _document(states: list[LinkState], number: str, took: float) -> dict[str, object]:
    from dataclasses import asdict

    links = {state.direction: asdict(state) for state in states}
    return {"schemaVersion": 1, "change": number, "seconds": round(took, 3), "links": links}


def _show(states: list[LinkState], took: float) -> None:
    from cloudrc.cli.output import table

    heads = ("DIRECTION", "SHAPER", "DELAY", "JITTER", "LOSS", "RATE", "OTHER")
    print(table([heads, *map(_row, states)]))
    print(f"in force after {took:.1f} s")


def _row(state: LinkState) -> tuple[str, ...]:
    asked, own = state.asked, state.profile.get(state.direction, {})
    delay, jitter = (asked.get(key) or 0.0 for key in ("delay", "jitter"))
    loss, rate = asked.get("loss") or 0.0, asked.get("rate")
    shape = f" {own.get('distribution', 'uniform')}" if jitter else ""
    return (
        state.direction,
        state.shaper,
        f"{delay * 1e3:g} ms",
        f"{jitter * 1e3:g} ms{shape}",
        f"{loss * 100:.3g} %",
        f"{rate * 1e-3:g} kbit/s" if rate else "-",
        ", ".join(_other_settings(own)) or "-",
    )


def _other_settings(own: Mapping[str, Any]) -> Iterator[str]:
    """Name the settings beyond delay, loss and rate: the time line and further impairments."""
    for key in ("changes", "blackouts"):
        if own.get(key):
            yield f"{len(own[key])} {key}"
    if own.get("trace"):
        yield f"trace {Path(own['trace']).name}"
    for key in ("duplicate", "reorder", "corrupt"):
        if own.get(key):
            yield f"{key} {own[key] * 100:.3g} %"
    if own.get("correlation"):
        yield f"correlation {own['correlation']:g}"
    if own.get("keep_order"):
        yield "order kept"
