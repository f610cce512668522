"""Read link profiles: every key with its unit, range and default, and the files that it names.

The name of a key ends with its unit (`delay_ms`). Unknown keys are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from cloudrc.config import problems, shipped
from cloudrc.config.problems import ConfigProblem
from cloudrc.config.section import Section
from cloudrc.link.profile import Blackout, Change, DirectionKeys, GilbertElliott, Probability
from cloudrc.link.traces import read_table, read_trace
from cloudrc.outside.document import Document, KeyPath
from cloudrc.outside.reuse import reuse

DIRECTIONS = ("uplink", "downlink")
FILE_READERS: dict[str, Callable[[Path], object]] = {"trace": read_trace, "table": read_table}
"""Key whose value is the path of a data file -> function that reads and checks the file."""
COMMAND_AGE_MS = 1, 10_000
"""Smallest and largest value of guard.command_age_max_ms [ms]."""
CommandAge = Annotated[float, Field(ge=COMMAND_AGE_MS[0], le=COMMAND_AGE_MS[1])]
CLOUD_TIME_MAX = 10
"""Largest value of cloud.horizon_max_s and of cloud.freeze_after_s [s]."""
CloudTime = Annotated[float, Field(gt=0, le=CLOUD_TIME_MAX)]


class BurstsConfig(Section, GilbertElliott):
    """Loss in bursts: a two-state Markov chain that takes one step per packet."""

    @model_validator(mode="after")
    def _ends(self) -> BurstsConfig:
        if self.bad_start > 0 and self.bad_end == 0:
            raise ValueError("bad_end must be above 0 if bad_start is: else a burst never ends")
        return self


def _loss_tag(value: Any) -> str:
    return "<bursts>" if isinstance(value, dict | GilbertElliott) else "<chance>"


LossConfig = Annotated[
    Annotated[Probability, Tag("<chance>")] | Annotated[BurstsConfig, Tag("<bursts>")],
    Discriminator(_loss_tag),
]


class BlackoutConfig(Section, Blackout):
    """An interval in which every packet is lost."""


class ChangeConfig(Section, Change):
    """A change of one direction of the link; a key that is not given keeps its value."""

    loss: LossConfig | None = None


class DirectionConfig(Section, DirectionKeys):
    """Network conditions of one direction. All delays are ONE WAY."""

    loss: LossConfig = 0.0
    changes: tuple[ChangeConfig, ...] = ()
    blackouts: tuple[BlackoutConfig, ...] = ()

    @model_validator(mode="after")
    def _check_table(self) -> DirectionConfig:
        if self.distribution == "table" and self.table is None:
            raise ValueError("distribution: table needs the key table: a CSV file of delays")
        return self

    @field_validator("changes")
    @classmethod
    def _check_times_rise(cls, changes: tuple[ChangeConfig, ...]) -> tuple[ChangeConfig, ...]:
        for index, (before, after) in enumerate(pairwise(changes), start=1):
            if after.at_s <= before.at_s:
                raise ValueError(
                    f"at_s must rise: entry {index} is at {after.at_s:g} s, "
                    f"the one before at {before.at_s:g} s"
                )
        return changes


class Profile(Section):
    """A link profile, such as the files under link/profiles."""

    description: str = ""
    """One line about the profile, for lists"""
    uplink: DirectionConfig = DirectionConfig()
    """Conditions from world to cloud"""
    downlink: DirectionConfig = DirectionConfig()
    """Conditions from cloud to world"""
    command_age_max_ms: CommandAge | None = None
    """Default of guard.command_age_max_ms with this profile [ms]; null: 250"""
    horizon_max_s: CloudTime | None = None
    """Default of cloud.horizon_max_s with this profile [s]; null: 1"""
    freeze_after_s: CloudTime | None = None
    """Default of cloud.freeze_after_s with this profile [s]; null: 0.4"""


def load_profile(name: str | Path) -> Profile:
    """Load a link profile by name or path; raises BadInputError."""
    return check_profile(shipped.read("profile", str(name), Path()), str(name))


def check_profile(document: Document, name: str) -> Profile:
    """Convert a document to a link profile; raises BadInputError about all its problems."""
    return problems.validate(document, Profile, name, resolve_files(document))


def resolve_files(document: Document, above: KeyPath = ()) -> list[ConfigProblem]:
    """Make the paths of a link absolute, which is at `above`, and check the files.

    Return the problems.
    """
    found: list[ConfigProblem] = []
    for path in [(*above, way, key) for way in DIRECTIONS for key in FILE_READERS]:
        name, source = document.get(*path), document.source(path)
        if isinstance(name, str):
            with problems.collect(found, path):
                file = str(source.absolute(name))
                check_file(path[-1], file)
                document.set_value(path, file, source)
    return found


def check_file(key: str, path: str) -> None:
    """Read a data file, or raise an error; a large trace takes long, so read it once a sweep."""
    reuse(("file", key, path), lambda: bool(FILE_READERS.get(key, Path)(Path(path))))
