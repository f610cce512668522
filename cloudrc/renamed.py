"""Old names of failure codes, metrics, columns and keys: older files and users still have them."""

from __future__ import annotations

import logging
from functools import cache

NEW_NAMES = {
    "pipe_touched": "obstacle_touched",
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
