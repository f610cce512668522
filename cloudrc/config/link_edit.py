# SPDX-License-Identifier: Apache-2.0

"""Change a link profile, as 'cloudrc link set' and the relays are asked to."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import Document
from cloudrc.config import overrides, shipped
from cloudrc.config.overrides import Settings
from cloudrc.config.profile import DIRECTIONS, ChangeConfig, check_profile, load_profile
from cloudrc.link.doubts import describe_heavy_loss
from cloudrc.link.profile import PERIOD_KEYS

CHANGEABLE_KEYS = ChangeConfig.model_fields.keys() - {"at_s"}
"""Keys of a direction that an entry of its list `changes` may set."""
SCHEDULE_KEYS = ("changes", "trace", "blackouts", "rate_trace", "loop", "repeat_s")
"""Keys of a direction that make up its schedule: how the link's conditions change over time."""
_SETTING = "downlink.delay_ms=120"
_EXAMPLE = f"for example {_SETTING}, or --profile handover"


class Edit(NamedTuple):
    """A link profile after a change by `cloudrc link set`."""

    values: dict[str, Any]  # as in a profile file, without defaults; paths are absolute
    cause: str  # the request in words
    restart: bool  # whether the schedule starts again when the profile takes effect
    notes: list[str]  # sentences for the user about side effects


def edit_profile(
    before: Document, profile: str | None, settings: Sequence[str], command: str = "link set"
) -> Edit:
    """Set values in the link profile `before`, or in the profile named `profile` if it is given.

    For each key in `settings`, remove the changes over time from the profile (for the delay also
    the trace), so that the key keeps the user's value. Raise a BadInputError, which names the
    `command`, if the request is empty or invalid.
    """
    if profile is None and not settings:
        raise BadInputError(f"nothing to set; name a value, {_EXAMPLE}")
    document, notes, restart = before, list[str](), profile is not None
    if profile is not None:
        new = load_profile(profile)
        document = shipped.read("profile", profile, Path())
        document.tree = new.model_dump(mode="json", exclude_defaults=True)
        if new.command_age_max_ms is not None:
            notes.append(
                f"profile {profile} needs guard.command_age_max_ms={new.command_age_max_ms:g}; the "
                "guard keeps the limit that it started with, so the robot may hold"
            )
    changes: Settings = {}
    for path, setting in overrides.parse_settings(settings, command, _SETTING).items():
        way, *keys = path[1:] if path[0] == "link" else path
        if (way, keys) == ("start_s", []):
            changes[(way,)], restart = setting, True
            continue
        if not keys or way not in DIRECTIONS:
            raise BadInputError(f"{'.'.join(path)}: set a key of uplink or downlink, {_EXAMPLE}")
        changes[way, *keys] = setting
        restart |= keys[0] in SCHEDULE_KEYS
        notes += _drop_from_schedule(document, way, keys[0])
    overrides.apply_overrides(document, changes)
    new_profile = check_profile(document, command)
    for way in DIRECTIONS:
        notes += describe_heavy_loss(getattr(new_profile, way), way)
    values = new_profile.model_dump(mode="json", exclude_defaults=True)
    words = [f"profile {profile}"] if profile else []
    return Edit(values, ", ".join([*words, *settings]), restart, notes)


def _drop_from_schedule(document: Document, way: str, key: str) -> list[str]:
    """Remove what changes `key` over time in the direction `way`; return notes for the user."""
    direction = document.get(way)
    if not isinstance(direction, dict) or key not in CHANGEABLE_KEYS:
        return []
    notes = []
    if [entry for entry in direction.get("changes") or () if entry.pop(key, None) is not None]:
        notes.append(f"the schedule of the {way} no longer changes {key}")
    if key == "delay_ms" and direction.pop("trace", None) is not None:
        notes.append(f"the {way} no longer follows its trace")
        if not any(direction.get(each) for each in PERIOD_KEYS):
            direction.pop("loop", None)
    elif key == "loss" and direction.get("trace"):
        notes.append(f"if the trace of the {way} has a column loss, it still sets the loss")
    return notes
