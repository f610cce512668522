# SPDX-License-Identifier: Apache-2.0

"""Verify a link: send probes, predict their delays and losses from the profile, and compare."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

DEFAULT = "paper"
"""Experiment whose link is verified by default, and that gets the profile to verify."""


def verdict_of(rows: Iterable[Any]) -> str:
    """Return "off" if a row is "off", "ok" if all judged ones are "ok", else "open".

    Rows are those of a measurement, or records `LinkChecked` of one.
    """
    verdicts = {row.verdict for row in rows} - {"told"}
    return "off" if "off" in verdicts else "ok" if verdicts == {"ok"} else "open"
