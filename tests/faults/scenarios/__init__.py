# SPDX-License-Identifier: Apache-2.0

"""Faults that are injected in virtual time, in modules for links, ends and intruders."""

from __future__ import annotations

from tests.faults.measures import Scenario
from tests.faults.scenarios import ends, intruder, links

_FOUND = [
    each
    for part in (ends, intruder, links)
    for each in vars(part).values()
    if isinstance(each, Scenario)
]
SCENARIOS = {each.name: each for each in sorted(_FOUND, key=lambda each: each.number)}
"""Name, such as cloud-killed -> scenario, by number."""
