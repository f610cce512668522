"""Both link containers of a release at once: a profile goes in, what each says of it comes out.

A link is set whole or not at all. Where only one direction takes a change, the files of before are
handed to both: to the one that took it, and to the other one, which would else find in a restart
what it has refused.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.cli.link_cluster_inside import hand_over
from cloudrc.cluster.errors import ClusterError
from cloudrc.cluster.link import COMPONENTS, PROFILE, LinkParts, Place
from cloudrc.config import document
from cloudrc.config.edit import DIRECTIONS, TIME_LINES
from cloudrc.config.load import FILES
from cloudrc.errors import CloudrcError
from cloudrc.link.sidecar_handed import Handed
from cloudrc.link.state import CHANGE_FILE, Change, LinkState, from_text, read_change

WAYS = dict(zip(COMPONENTS, DIRECTIONS, strict=True))
"""What the link container of a component shapes."""
Answer: TypeAlias = LinkState | CloudrcError
"""What a link container tells of itself, or why it tells nothing."""


@dataclass(frozen=True)
class Given:
    """A change that both containers were asked to take over.

    Attributes:
        change: Number, cause, and whether time lines begin anew.
        answers: What each of the components' containers said.
    """

    change: Change
    answers: Mapping[str, Answer]

    def took(self, part: str) -> bool:
        """Whether a component's container has it in force."""
        told = self.answers[part]
        return isinstance(told, LinkState) and told.change == self.change.number

    def refused(self, part: str) -> bool:
        """Whether a component's container has said that it cannot."""
        told = self.answers[part]
        return isinstance(told, LinkState) and told.refused == self.change.number


class StrangeStateError(ClusterError):
    """A link container that tells of itself in another way than this version's."""


def hand_to_both(place: Place, link: LinkParts, given: Mapping[str, Handed]) -> dict[str, Answer]:
    """Hand a document to each link container, and wait until both have decided.

    Args:
        place: Of the release.
        link: Its link.
        given: By component.

    Returns:
        By component.
    """

    def hand(part: str) -> Answer:
        try:
            return from_text(hand_over(place, link.pods[part], given[part]))
        except CloudrcError as error:
            return error
        except ValueError as error:
            return StrangeStateError(f"a link container is of another version: {error}")

    with ThreadPoolExecutor(len(COMPONENTS)) as pool:
        return dict(zip(COMPONENTS, pool.map(hand, COMPONENTS), strict=True))


def needed(values: Mapping[str, Any], files: Mapping[str, str]) -> dict[str, str]:
    """Choose from a ConfigMap's files the profile and what it names.

    Args:
        values: The profile, read.
        files: All there are.
    """
    ways = [one for one in values.values() if isinstance(one, dict)]
    named = {Path(str(one[key])).name for one in ways for key in FILES if one.get(key)}
    return {name: text for name, text in files.items() if name == PROFILE or name in named}


def take_back(place: Place, link: LinkParts, given: Given) -> str:
    """Hand the files of before to both link containers again.

    Args:
        place: Of the release.
        link: Its link as it was before.
        given: What was not taken over by both.

    Returns:
        What holds now where that is not just as before, and what to do; "" if there is nothing.
    """
    values, _ = document.parse(link.files[PROFILE], PROFILE)
    values = values if isinstance(values, dict) else {}
    files = needed(values, link.files)
    before = read_change(link.files.get(CHANGE_FILE, "")).number
    number, cause = f"{given.change.number}-back", f"taken back: {given.change.cause}"
    documents = {}
    for part in COMPONENTS:
        # Where it never took force, the old time line goes on.
        restart = given.change.restart and given.took(part)
        change = {"number": number, "cause": cause, "restart": restart}
        documents[part] = Handed(json.dumps(change) + "\n", before, files)
    again = Given(Change(number, cause), hand_to_both(place, link, documents))
    return "; ".join(_words(place, link, values, given, again))


def _words(
    place: Place, link: LinkParts, values: Mapping[str, Any], given: Given, again: Given
) -> Iterator[str]:
    """Say for each direction what it has in the end."""
    for part, way in WAYS.items():
        own, told = values.get(way) or {}, again.answers[part]
        if again.took(part):
            if given.took(part):
                anew = given.change.restart and any(own.get(key) for key in TIME_LINES)
                timed = ", its time line begins anew" if anew else ""
                yield f"the {way} had taken the change, and has its old profile back{timed}"
        elif isinstance(told, LinkState) and not again.refused(part):
            yield f"the {way} (pod {link.pods[part]}) finds its old profile once it moves again"
        else:
            keeps = "keeps the change" if given.took(part) else "may have the change"
            if given.refused(part):
                keeps = "may take what it refused when its container starts again"
            why = told.refusal if isinstance(told, LinkState) else str(told)
            yield (
                f"the {way} (pod {link.pods[part]}) {keeps}, as it could not be taken back: {why}; "
                f"hand both the old profile again: {_command(place, way, own)}"
            )


def _command(place: Place, way: str, own: Mapping[str, Any]) -> str:
    """Give the command that sets a value as it is, and so hands over the profile that lasts.

    The order is on no time line, and setting it leaves all else as it is.
    """
    order = "true" if own.get("keep_order") else "false"
    words = ["cloudrc link set", f"{way}.keep_order={order}", f"--release={place.name}"]
    return " ".join([*words, *place.flags])
