"""Old names of failure codes, metrics and columns: older files and users still have them."""

from __future__ import annotations

import logging
from functools import cache

NEW_NAMES = {
    "pipe_touched": "obstacle_touched",
    "pipe_contacts": "obstacle_contacts",
}
"""Old name -> new name."""


@cache
def new_name(name: str) -> str:
    """Return the present name of what a user calls `name`; log once if that is the old name."""
    new = NEW_NAMES.get(name, name)
    if new != name:
        logging.getLogger("cloudrc").warning("%s is called %s now", name, new)
    return new


def with_new_names(text: str) -> str:
    """Replace the old names in a text that cloudrc has written."""
    for old, new in NEW_NAMES.items():
        text = text.replace(old, new)
    return text
