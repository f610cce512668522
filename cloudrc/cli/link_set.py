"""`cloudrc link set`: change the link of a flight under way, here or in a cluster."""

from __future__ import annotations

import argparse
import json
import secrets
import sys
from collections.abc import Callable
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING

from cloudrc.cli.cluster_flags import place, place_arguments
from cloudrc.errors import BadInputError, CloudrcError, MissingPrerequisiteError, TimedOutError

if TYPE_CHECKING:
    from cloudrc.cli.link_edit import Edit
    from cloudrc.link.state import LinkState

    Look = Callable[[], list[LinkState]]

EPILOG = """\
where:
  the run that flies here ('cloudrc run --mode local'), found by itself or by
  --run; or a release: with --context, -n or --release, or if none flies here

examples:
  cloudrc link set downlink.delay_ms=120 uplink.loss=0.02
  cloudrc link set --profile handover
  cloudrc link set --profile lan uplink.rate_kbit=400 -n demo

Keys are those of a profile's direction. A profile's time line counts from now;
single values leave it as it goes. The change is recorded, and lasts until the
next one, the end of the run, or 'helm upgrade'."""
LOCAL_PATIENCE = 5.0
"""For the relay of a run here to take a change over [s]; it takes 0.2."""
CLUSTER_PATIENCE = 120.0
"""Likewise in a cluster, where a kubelet may look at its volumes once a minute only [s]."""
LOOK_PERIOD = 0.05
"""Between two looks [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "settings", nargs="*", metavar="KEY=VALUE", help="uplink.KEY=VALUE or downlink.KEY=VALUE"
    )
    parser.add_argument("--profile", metavar="NAME", help="a profile that ships, or a file")
    parser.add_argument("--run", type=Path, metavar="DIR", help="folder of the run that flies here")
    parser.add_argument(
        "-o", "--output", choices=("table", "json"), default="table", help="default: table"
    )
    place_arguments(parser)


def execute(options: argparse.Namespace) -> int:
    """Set the link, and say what is in force then."""
    number = secrets.token_hex(4)
    folder = _folder_here(options)
    began = monotonic()
    if folder is not None:
        edit, look = _set_here(options, folder, number)
        states = _await(look, number, LOCAL_PATIENCE, f"see {folder.parent / 'relay.log'}")
    else:
        edit, look = _set_in_cluster(options, number)
        states = _await(look, number, CLUSTER_PATIENCE, "see the logs of the link containers")
    took = monotonic() - began
    for note in edit.notes:
        print(f"cloudrc: note: {note}", file=sys.stderr)
    if options.output == "json":
        print(json.dumps(_document(states, number, took), indent=2))
    else:
        _show(states, took)
    return 0


def _folder_here(options: argparse.Namespace) -> Path | None:
    """Find the link of the run that flies here, unless the flags name a cluster."""
    from cloudrc.cli.folder import RUNS
    from cloudrc.drivers.local import LINK_FOLDER

    in_cluster = options.context or options.namespace or options.release
    if options.run is not None:
        if in_cluster:
            raise BadInputError("--run names a run here, the other flags a cluster; give one")
        if not (options.run / LINK_FOLDER).is_dir():
            raise BadInputError(f"--run {options.run}: no run flies there")
        return Path(options.run / LINK_FOLDER)
    folder = RUNS / "latest" / LINK_FOLDER
    return folder if not in_cluster and folder.is_dir() else None


def _set_here(options: argparse.Namespace, folder: Path, number: str) -> tuple[Edit, Look]:
    """Leave a new profile where the run's relay looks for it."""
    from cloudrc.cli.link_edit import DIRECTIONS, edit
    from cloudrc.cli.relay_control import PROFILE_FILE
    from cloudrc.config.document import Document
    from cloudrc.link.route import publish
    from cloudrc.link.state import CHANGE_FILE, from_text

    def look() -> list[LinkState]:
        try:
            texts = [(folder / f"{way}.json").read_text("utf-8") for way in DIRECTIONS]
            return [from_text(text) for text in texts]
        except (OSError, ValueError):
            return []

    states = look()
    if not states:
        raise BadInputError(f"{folder.parent}: no link is up there (yet); wait for the start")
    made = edit(Document(states[0].profile), options.profile, options.settings)
    publish(folder / CHANGE_FILE, _change(made, number))
    publish(folder / PROFILE_FILE, json.dumps(made.values, indent=2) + "\n")
    return made, look


def _set_in_cluster(options: argparse.Namespace, number: str) -> tuple[Edit, Look]:
    """Leave a new profile in the release's ConfigMap, and have the kubelets look at it."""
    try:
        release = place(options)
    except MissingPrerequisiteError as error:
        if options.context or options.namespace:
            raise
        raise MissingPrerequisiteError(
            f"no run flies here (start one: cloudrc run), and {error}"
        ) from None
    from cloudrc.cli.link_cluster import change_profile
    from cloudrc.cluster.link import LinkPods
    from cloudrc.link.state import from_text

    made = change_profile(
        release, options.profile, options.settings, lambda edit: _change(edit, number)
    )
    pods = LinkPods(release, number)

    def look() -> list[LinkState]:
        try:
            return [from_text(text) for text in pods.states()]
        except ValueError:
            return []

    return made, look


def _change(edit: Edit, number: str) -> str:
    return json.dumps({"number": number, "cause": edit.cause, "restart": edit.restart}) + "\n"


def _await(look: Look, number: str, patience: float, where: str) -> list[LinkState]:
    """Wait until both directions say that the change is in force.

    Raises:
        CloudrcError: If it is refused, or not in force in time.
    """
    until = monotonic() + patience
    while True:
        states = look()
        for state in states:
            if state.refused == number:
                raise _RefusedError(f"the {state.direction} is as it was: {state.refusal}")
        if states and all(state.change == number for state in states):
            return states
        if monotonic() > until:
            late = [s.direction for s in states if s.change != number] or ["link"]
            raise TimedOutError(
                f"the {' and '.join(late)} did not take the change over within {patience:g} s; "
                f"{where}"
            )
        sleep(LOOK_PERIOD)


class _RefusedError(CloudrcError):
    """The link cannot be what was asked for."""

    exit_code = 2


def _document(states: list[LinkState], number: str, took: float) -> dict[str, object]:
    from dataclasses import asdict

    links = {state.direction: asdict(state) for state in states}
    return {"schemaVersion": 1, "change": number, "seconds": round(took, 3), "links": links}


def _show(states: list[LinkState], took: float) -> None:
    from cloudrc.cli.output import table

    heads = ("DIRECTION", "SHAPER", "DELAY", "JITTER", "LOSS", "RATE", "TIME LINE")
    print(table([heads, *map(_row, states)]))
    print(f"in force after {took:.1f} s")


def _row(state: LinkState) -> tuple[str, ...]:
    asked, own = state.asked, state.profile.get(state.direction, {})
    delay, jitter = (asked.get(key) or 0.0 for key in ("delay", "jitter"))
    loss, rate = asked.get("loss") or 0.0, asked.get("rate")
    shape = f" {own.get('distribution', 'uniform')}" if jitter else ""
    line = [f"{len(own[key])} {key}" for key in ("changes", "blackouts") if own.get(key)]
    line += [f"trace {Path(own['trace']).name}"] if own.get("trace") else []
    return (
        state.direction,
        state.shaper,
        f"{delay * 1e3:g} ms",
        f"{jitter * 1e3:g} ms{shape}",
        f"{loss * 100:.3g} %",
        f"{rate * 1e-3:g} kbit/s" if rate else "-",
        ", ".join(line) or "-",
    )
