"""All scenarios: the families are found by their files' names, their faults sorted by number."""

from __future__ import annotations

import importlib
import pkgutil
from typing import get_args

import cloudrc.faults
from cloudrc.errors import BadInputError
from cloudrc.faults.scenario import Mode, Scenario
from cloudrc.plugins import meant

FAMILY = ".family_"
MODES = get_args(Mode)


def scenarios(mode: Mode | None = None) -> list[Scenario]:
    """List the faults, sorted.

    Args:
        mode: Only those that run there; None for all.
    """
    found: list[Scenario] = []
    for module in pkgutil.walk_packages(cloudrc.faults.__path__, "cloudrc.faults."):
        if FAMILY in module.name:
            found += importlib.import_module(module.name).SCENARIOS
    chosen = [each for each in found if mode is None or each.mode == mode]
    return sorted(chosen, key=lambda each: (each.number, MODES.index(each.mode)))


def find(name: str, mode: Mode) -> Scenario:
    """Give a fault by its name (cloud-killed), or the first of a number (F13).

    Raises:
        BadInputError: If there is none in this mode; names those that there are.
    """
    return called(name, mode)[0]


def called(name: str, mode: Mode) -> list[Scenario]:
    """Give the fault of a name, or all of a number: F31 with real processes are two.

    Raises:
        BadInputError: If there is none in this mode; names those that there are.
    """
    there = scenarios(mode)
    if found := [each for each in there if name.lower() in (each.id.lower(), each.name)]:
        return found
    for other in scenarios():
        if name.lower() in (other.id.lower(), other.name):
            flag = "" if other.mode == "virtual" else f" --{other.mode}"
            raise BadInputError(
                f"{other.id} {other.name} is not in mode {mode}; try:"
                f" cloudrc faults run {other.name}{flag}"
            )
    names = ", ".join(f"{each.id} {each.name}" for each in there) or "none"
    hint = meant(name.lower(), [each.name for each in there])
    raise BadInputError(f"no fault '{name}' in mode {mode}; there are: {names}{hint}")
