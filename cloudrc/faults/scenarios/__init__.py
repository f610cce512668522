"""Faults that are injected in virtual time, in modules for links, ends and intruders."""

from __future__ import annotations

from cloudrc.errors import BadInputError
from cloudrc.faults.measures import Scenario
from cloudrc.faults.scenarios import ends, intruder, links
from cloudrc.text import suggest_name

MODULES = (ends, intruder, links)
_FOUND = [each for part in MODULES for each in vars(part).values() if isinstance(each, Scenario)]
SCENARIOS = tuple(sorted(_FOUND, key=lambda each: each.number))  # all scenarios, by number


def find(name: str) -> Scenario:
    """Return a scenario by its name (cloud-killed) or number (F13).

    Raises:
        BadInputError: If there is no such scenario; the message lists all scenarios.
    """
    for each in SCENARIOS:
        if name.lower() in (each.id.lower(), each.name):
            return each
    names = ", ".join(f"{each.id} {each.name}" for each in SCENARIOS)
    hint = suggest_name(name.lower(), [each.name for each in SCENARIOS])
    raise BadInputError(f"no fault '{name}'; there are: {names}{hint}")
