"""Edit a link profile for `cloudrc link set`.

A value that the user sets stays in force. If the time line (changes, trace) sets the same value,
the value is removed from the time line. The rest of the time line continues.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cloudrc.config import overrides, shipped
from cloudrc.config.document import SET_LABEL, Document, Source
from cloudrc.config.load import FILE_READERS, check_profile, load_profile
from cloudrc.config.overrides import Override
from cloudrc.config.schema import Change
from cloudrc.errors import BadInputError

DIRECTIONS = ("uplink", "downlink")
CHANGEABLE_KEYS = Change.model_fields.keys() - {"at_s"}
"""Keys of a direction that an entry of `changes` may set."""
TIME_LINE_KEYS = ("changes", "trace", "blackouts")
"""Keys of a direction that make its conditions depend on time."""
_HERE = "link set"
_EXAMPLE = "for example downlink.delay_ms=120, or --profile handover"


@dataclass(frozen=True, slots=True)
class Edit:
    """An edited profile.

    Attributes:
        values: Values as in a profile file, without defaults; paths are absolute.
        cause: The request in words.
        restart: True if the time line starts again when the profile takes effect, False if the
            time line continues.
        notes: Sentences for the user about side effects.
    """

    values: dict[str, Any]
    cause: str
    restart: bool
    notes: list[str] = field(default_factory=list)


def edit_profile(before: Document, profile: str | None, settings: Sequence[str]) -> Edit:
    """Change a profile.

    Args:
        before: The present profile.
        profile: Name or path of a profile that replaces the present profile; None to edit the
            present profile.
        settings: Values to set, such as "downlink.delay_ms=120".

    Raises:
        BadInputError: If the request is empty or not valid.
    """
    if profile is None and not settings:
        raise BadInputError(f"nothing to set; name a value, {_EXAMPLE}")
    notes: list[str] = []
    document = before if profile is None else _load(profile, notes)
    restart = profile is not None
    changes = [_without_prefix(change) for change in overrides.parse_settings(settings)]
    for change in changes:
        restart |= change.path[1] in TIME_LINE_KEYS
        _drop_from_time_line(document, change, notes)
    overrides.apply_overrides(document, changes)
    document.sources = {
        path: Source(_HERE, source.folder) if source.label == SET_LABEL else source
        for path, source in document.sources.items()
    }
    values = check_profile(document, _HERE).model_dump(mode="json", exclude_defaults=True)
    words = [f"profile {profile}"] if profile else []
    return Edit(values, ", ".join([*words, *settings]), restart, notes)


def check_edit(profile: str | None, settings: Sequence[str]) -> None:
    """Refuse a request that is wrong, whatever the present profile is.

    Raises:
        BadInputError: If the request is empty or not valid.
    """
    independent = [
        text
        for text in settings
        if text.partition("=")[0].rpartition(".")[2] not in ("distribution", *FILE_READERS)
    ]
    if profile is not None or independent or not settings:
        edit_profile(Document({}), profile, independent)


def _load(name: str, notes: list[str]) -> Document:
    profile = load_profile(name)
    age_max = profile.command_age_max_ms
    if age_max is not None:
        notes.append(
            f"profile {name} needs guard.command_age_max_ms={age_max:g}; the guard keeps the limit "
            "that it started with, so the robot may hold"
        )
    document = shipped.read("profile", name, Path())
    document.tree = profile.model_dump(mode="json", exclude_defaults=True)
    return document


def _without_prefix(change: Override) -> Override:
    """Remove a leading "link."; refuse a key that belongs to no direction."""
    path = change.path[1:] if change.path[0] == "link" else change.path
    if len(path) < 2 or path[0] not in DIRECTIONS:
        raise BadInputError(f"{'.'.join(change.path)}: set a key of uplink or downlink, {_EXAMPLE}")
    return Override(path, change.value)


def _drop_from_time_line(document: Document, change: Override, notes: list[str]) -> None:
    """Remove the key that the user sets from a direction's time line."""
    way, key = change.path[:2]
    direction = document.get(way)
    if not isinstance(direction, dict) or key not in CHANGEABLE_KEYS:
        return
    direction = document.tree[way] = copy.deepcopy(direction)
    changes = direction.get("changes") or ()
    dropped = [entry for entry in changes if entry.pop(key, None) is not None]
    if dropped:
        notes.append(f"the time line of the {way} no longer changes {key}")
    if key == "delay_ms" and direction.pop("trace", None) is not None:
        notes.append(f"the {way} no longer follows its trace")
    elif key == "loss" and direction.get("trace"):
        notes.append(f"if the trace of the {way} has a column loss, it still sets the loss")
