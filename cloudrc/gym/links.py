# SPDX-License-Identifier: Apache-2.0

"""Choose the link of each episode: always one, one of several, or what a function returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.link.library import LinkProfile, read_profile
from cloudrc.link.profile import RANDOM
from cloudrc.link.start import draw

Profile = str | Path | Mapping[str, Any] | LinkProfile
Links = Profile | Sequence[Profile] | Callable[[int], Profile]
"""The link of all episodes; several, of which one is drawn for each episode; or a function from the
seed of an episode to its link."""
KIND = 133
"""Kind of the random numbers with which one of several links is drawn."""


class Chosen(NamedTuple):
    """The link of an episode."""

    name: str
    profile: LinkProfile


Choose = Callable[[int, int, str], Chosen]
"""Function from the seed of an episode, its number in the network, and the stream to its link."""


def choose_link(links: Links, seed: int) -> tuple[Choose, list[LinkProfile]]:
    """Return the function that chooses the link of each episode, and the links that are known.

    `seed` is that of the network.

    Raises:
        BadInputError: If a link is none.
    """
    if callable(links):
        return partial(_call, links), []
    if isinstance(links, str | Path | Mapping | LinkProfile) or not isinstance(links, Sequence):
        every = [read(links, "a link of the program")]
    else:
        every = [read(each, f"link {n} of {len(links)}") for n, each in enumerate(links, 1)]
    if not every:
        raise InvalidValueError("link: the list is empty; give at least one profile")
    return partial(_draw_one, every, seed), [each.profile for each in every]


# No local functions: loops are pickled.


def _call(given: Callable[[int], Profile], own: int, episode: int, stream: str) -> Chosen:
    return read(given(own), "a link of the function")


def _draw_one(every: Sequence[Chosen], seed: int, own: int, episode: int, stream: str) -> Chosen:
    if len(every) == 1:
        return every[0]
    return every[int(draw(seed, episode, KIND, stream) * len(every))]


def read(link: Profile, name: str) -> Chosen:
    """Read a link; `name` is that of one which is neither a name nor a file.

    Its schedule, if it has a period, begins at random, unless the profile says where.
    """
    profile = read_profile(link)
    if profile.start_s is None and profile.period_ns:
        profile = replace(profile, start_s=RANDOM)
    return Chosen(str(link) if isinstance(link, str | Path) else name, profile)
