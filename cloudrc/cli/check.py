"""One line of the doctor: what was looked at, what is there, and what to do about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

FLYING = ("virtual", "local")
CLUSTER = ("cluster",)


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the doctor.

    Attributes:
        name: What was looked at.
        state: "ok"; "warn": it will fly, but see `fix`; "missing".
        found: What is there, in words.
        fix: What to do about it; empty if nothing.
        modes: Modes that cannot run without it.
    """

    name: str
    state: Literal["ok", "warn", "missing"]
    found: str
    fix: str = ""
    modes: tuple[str, ...] = ()
