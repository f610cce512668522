# SPDX-License-Identifier: Apache-2.0

"""Read link profiles: every key with its unit, range and default, and the files that it names.

The name of a key ends with its unit (`delay_ms`). Unknown keys are refused.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import Discriminator, Field, Tag, model_validator

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.document import Document, KeyPath
from cloudrc.base.outside.reuse import reuse
from cloudrc.config import problems, shipped
from cloudrc.config.problems import ConfigProblem
from cloudrc.config.section import Section, leave_out_unset
from cloudrc.link.profile import CLOUD_TIME_MAX as CLOUD_TIME_MAX
from cloudrc.link.profile import COMMAND_AGE_MS as COMMAND_AGE_MS
from cloudrc.link.profile import DIRECTIONS as DIRECTIONS
from cloudrc.link.profile import RANDOM as RANDOM
from cloudrc.link.profile import (
    Blackout,
    Change,
    DirectionKeys,
    GilbertElliott,
    NotNegative,
    Probability,
    ProfileKeys,
    Radio,
    refuse_period,
)
from cloudrc.link.profile import CloudTime as CloudTime
from cloudrc.link.profile import CommandAge as CommandAge
from cloudrc.link.traces import read_opportunities, read_table, read_trace

FILE_READERS: dict[str, Callable[[Path], object]] = {
    "trace": read_trace,
    "table": read_table,
    "rate_trace": read_opportunities,
}
"""Key whose value is the path of a data file -> function that reads and checks the file."""


LATER_KEYS = ("rate_trace", "repeat_s", "radio")
"""Keys of a direction that are left out where they are null, as before there were any."""
_Keys = TypeVar("_Keys", GilbertElliott, DirectionKeys, ProfileKeys, Radio)


def _refuse_conflict(keys: _Keys) -> _Keys:
    """Raise a ValueError if keys of a section do not agree with each other."""
    if text := keys.conflict():
        raise ValueError(text)
    return keys


class BurstsConfig(Section, GilbertElliott):
    """Loss in bursts: a two-state Markov chain that takes one step per packet."""

    _agree = model_validator(mode="after")(_refuse_conflict)


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


def _compute_tag(value: Any) -> str:
    return "<file>" if isinstance(value, str) else "<time>"


ComputeMs = Annotated[
    Annotated[float, Field(ge=0, le=1000), Tag("<time>")] | Annotated[str, Tag("<file>")],
    Discriminator(_compute_tag),
]
"""A time [ms], or the path of a file with times."""


def _start_tag(value: Any) -> str:
    return "<word>" if isinstance(value, str) else "<time>"


StartConfig = Annotated[
    Annotated[NotNegative, Tag("<time>")] | Annotated[Literal["random"], Tag("<word>")],
    Discriminator(_start_tag),
]


class RadioConfig(Section, Radio):
    """A radio that schedules: it has slots for one direction at a time, and grants them."""

    phase_ms: StartConfig = 0.0

    _agree = model_validator(mode="after")(_refuse_conflict)


class DirectionConfig(Section, DirectionKeys):
    """Network conditions of one direction. All delays are ONE WAY."""

    loss: LossConfig = 0.0
    radio: RadioConfig | None = None
    changes: tuple[ChangeConfig, ...] = ()
    blackouts: tuple[BlackoutConfig, ...] = ()

    _agree = model_validator(mode="after")(_refuse_conflict)
    _write = leave_out_unset(*LATER_KEYS)


class Profile(Section, ProfileKeys):
    """A link profile, such as the files under link/profiles."""

    uplink: DirectionConfig = DirectionConfig()
    downlink: DirectionConfig = DirectionConfig()
    start_s: StartConfig | None = None

    _agree = model_validator(mode="after")(_refuse_conflict)


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
                file = source.absolute(name)
                _check_file(path[-1], file)
                if path[-1] == "trace":
                    _check_period(document.get(*path[:-1], "repeat_s"), file)
                document.set_value(path, str(file), source)
    return found


def _check_period(period: Any, trace: Path) -> None:
    if isinstance(period, float | int):
        last = reuse(("last row", trace), lambda: read_trace(trace).times[-1])
        if text := refuse_period(period, last):
            raise BadInputError(text)


def _check_file(key: str, path: Path) -> None:
    """Read a data file, or raise an error; a large trace takes long, so read it once a sweep."""
    reuse(("file", key, path), lambda: bool(FILE_READERS[key](path)))
