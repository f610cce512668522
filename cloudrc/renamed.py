"""Old names of failure codes, metrics, columns and keys: older files and users still have them."""

from __future__ import annotations

import logging
from functools import cache
from typing import Any

NEW_NAMES = {
    "pipe_touched": "obstacle_touched",
    "board_not_touched": "not_touched",
    "pipe_contacts": "obstacle_contacts",
}
"""Old name -> new name."""
NEW_KEYS = {
    "world.low_level": "world.onboard",
    "world.plant.thrust_factor": "world.plant.actuator_factor",
}
"""Old key of an experiment -> new key in the same section; the keys below it move with it."""


@cache
def new_name(name: str) -> str:
    """Return the present name of what a user calls `name`; log once if that is the old name."""
    new = NEW_NAMES.get(name, name)
    if new != name:
        _log(name, new)
    return new


@cache
def new_key(key: str) -> str:
    """Return the present name of a key of an experiment; log once if `key` is the old name."""
    for old, new in NEW_KEYS.items():
        if f"{key}.".startswith(f"{old}."):
            _log(key, new + key[len(old) :])
            return new + key[len(old) :]
    return key


def _log(old: str, new: str) -> None:
    logging.getLogger("cloudrc").warning("%s is called %s now", old, new)


def with_new_names(text: str) -> str:
    """Replace the old names in a text that cloudrc has written."""
    for old, new in NEW_NAMES.items():
        text = text.replace(old, new)
    return text


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
