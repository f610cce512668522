"""Old names of codes, events, metrics, columns and keys: older files and users still have them."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping
from functools import cache
from typing import Any

NEW_NAMES = {
    "pipe_touched": "obstacle_touched",
    "board_not_touched": "not_touched",
    "pipe_contacts": "obstacle_contacts",
    "board_touched": "touched",
    "tip_speed": "touch_speed",
}
"""Old name -> new name of codes, events and metrics."""
NEW_COLUMNS = {
    "pipe_contacts": "obstacle_contacts",
    "tip": "by_probe",
    "tip_force": "force",
    "tip_force_peak": "force_peak",
    "tip_impulse": "impulse",
    "tip_velocity": "touch_velocity",
}
"""Old name -> new name of the columns of a recording."""
NEW_KEYS = {
    "world.low_level": "world.onboard",
    "world.plant.thrust_factor": "world.plant.actuator_factor",
}
"""Old key of an experiment -> new key in the same section; the keys below it move with it."""


@cache
def new_name(name: str) -> str:
    """Return the present name of what a user calls `name`; log once if that is the old name."""
    return _told(name, NEW_NAMES)


@cache
def new_column(name: str) -> str:
    """Return the present name of a column; log once if `name` is the old name."""
    return _told(name, NEW_COLUMNS)


@cache
def new_key(key: str) -> str:
    """Return the present name of a key of an experiment; log once if `key` is the old name."""
    for old, new in NEW_KEYS.items():
        if f"{key}.".startswith(f"{old}."):
            _log(key, new + key[len(old) :])
            return new + key[len(old) :]
    return key


def _told(name: str, table: Mapping[str, str]) -> str:
    new = table.get(name, name)
    if new != name:
        _log(name, new)
    return new


def _log(old: str, new: str) -> None:
    logging.getLogger("cloudrc").warning("%s is called %s now", old, new)


def with_new_names(text: str) -> str:
    """Replace the old names in a text that cloudrc has written."""
    return _replace(text, NEW_NAMES)


def with_new_columns(definition: str) -> str:
    """Replace the old names of columns in the definition of a message's type."""
    return _replace(definition, NEW_COLUMNS)


def _replace(text: str, table: Mapping[str, str]) -> str:
    return re.sub(r"\w+", lambda word: table.get(word[0], word[0]), text)


OLD_BODY = "board"
"""The body that a mission with `criteria.contact: true` had to touch."""


def touch(key: str, value: Any, *, told: bool) -> tuple[tuple[str, ...], Any]:
    """Return path and value that replace the old key `contact...` of an experiment's criteria.

    A wrong value stays wrong. Log the new key if the user has to be `told`.
    """
    path: tuple[str, ...] = ("mission", "touch", "speed_max_mps")
    if key == "contact":
        path, value = _touch_of(value)
    if told:
        shown = "null" if value is None else value
        tell(f"criteria.{key}", f"{'.'.join(path)}={shown}")
    return path, value


def _touch_of(contact: Any) -> tuple[tuple[str, ...], Any]:
    if contact is False:
        return ("mission", "touch"), None
    return ("mission", "touch", "body"), OLD_BODY if contact is True else contact


def with_touch(order: dict[str, Any]) -> dict[str, Any]:
    """Return an order from a journal of missions in the form that it has now."""
    has_to_touch = order.pop("contact", False)
    return order | {"touch": {"body": OLD_BODY}} if has_to_touch else order


@cache
def tell(old: str, new: str) -> None:
    """Log once that what a user calls `old` is `new` now."""
    logging.getLogger("cloudrc").warning("%s is %s now", old, new)
