"""What `cloudrc link set` thinks: a profile and what is to change go in, a new profile comes out.

What is set by hand holds from then on: where the time line sets the same value it is dropped from
there, else nothing would be seen of it. What else is on the time line goes on.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cloudrc.config import overrides, shipped
from cloudrc.config.document import SETTING, Document, Source
from cloudrc.config.load import FILES, check_profile, load_profile
from cloudrc.config.overrides import Override
from cloudrc.config.schema import Change
from cloudrc.errors import BadInputError

DIRECTIONS = ("uplink", "downlink")
ON_TIME_LINE = Change.model_fields.keys() - {"at_s"}
"""Values that a time line's changes may set."""
TIME_LINES = ("changes", "trace", "blackouts")
_HERE = "link set"
_EXAMPLE = "for example downlink.delay_ms=120, or --profile handover"


@dataclass(frozen=True, slots=True)
class Edit:
    """A new profile.

    Attributes:
        values: As in a profile's file, defaults left out; paths are absolute.
        cause: What was asked for, in words.
        restart: Whether its time line counts from when it takes force; else it goes on.
        notes: What a person should know.
    """

    values: dict[str, Any]
    cause: str
    restart: bool
    notes: list[str] = field(default_factory=list)


def edit(before: Document, profile: str | None, settings: Sequence[str]) -> Edit:
    """Change a profile.

    Args:
        before: What holds now.
        profile: Name or path of one that takes its place; None changes the old one.
        settings: "downlink.delay_ms=120" texts over it.

    Raises:
        BadInputError: If nothing is asked for, or what is asked for is not valid.
    """
    if profile is None and not settings:
        raise BadInputError(f"nothing to set; say what, {_EXAMPLE}")
    notes: list[str] = []
    document = before if profile is None else _load(profile, notes)
    restart = profile is not None
    changes = [_checked(change) for change in overrides.parse(settings)]
    for change in changes:
        restart |= change.path[1] in TIME_LINES
        _take_over(document, change, notes)
    overrides.apply(document, changes)
    document.sources = {
        path: Source(_HERE, source.folder) if source.label == SETTING else source
        for path, source in document.sources.items()
    }
    made = check_profile(document, _HERE).model_dump(mode="json", exclude_defaults=True)
    words = [f"profile {profile}"] if profile else []
    return Edit(made, ", ".join([*words, *settings]), restart, notes)


def check(profile: str | None, settings: Sequence[str]) -> None:
    """Refuse what is wrong whatever the link is now, as far as that can be told.

    Raises:
        BadInputError: As `edit`.
    """
    alone = [
        text
        for text in settings
        if text.partition("=")[0].rpartition(".")[2] not in ("distribution", *FILES)
    ]
    if profile is not None or alone or not settings:
        edit(Document({}), profile, alone)


def _load(name: str, notes: list[str]) -> Document:
    profile = load_profile(name)
    age_max = profile.command_age_max_ms
    if age_max is not None:
        notes.append(
            f"profile {name} wants guard.command_age_max_ms={age_max:g}; the guard of this flight "
            "keeps the limit that it began with, and may hold"
        )
    document = shipped.read("profile", name, Path())
    document.tree = profile.model_dump(mode="json", exclude_defaults=True)
    return document


def _checked(change: Override) -> Override:
    """Take a leading "link." away; refuse what is no direction's."""
    path = change.path[1:] if change.path[0] == "link" else change.path
    if len(path) < 2 or path[0] not in DIRECTIONS:
        raise BadInputError(
            f"{'.'.join(change.path)}: give a value of uplink or downlink, {_EXAMPLE}"
        )
    return Override(path, change.value)


def _take_over(document: Document, change: Override, notes: list[str]) -> None:
    """Drop from a direction's time line what is set by hand."""
    way, key = change.path[:2]
    direction = document.get(way)
    if not isinstance(direction, dict) or key not in ON_TIME_LINE:
        return
    direction = document.tree[way] = copy.deepcopy(direction)
    dropped = [one for one in direction.get("changes") or () if one.pop(key, None) is not None]
    if dropped:
        notes.append(f"the {way}'s time line does not change {key} any more")
    if key == "delay_ms" and direction.pop("trace", None) is not None:
        notes.append(f"the {way} does not follow its trace any more")
    elif key == "loss" and direction.get("trace"):
        notes.append(f"if the {way}'s trace has a column loss, that goes on setting it")
