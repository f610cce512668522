# SPDX-License-Identifier: Apache-2.0

"""Read what the flags of `cloudrc eval` give."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.base.outside.address import check_url
from cloudrc.base.outside.document import parse_value, read_document
from cloudrc.base.outside.paths import check_new
from cloudrc.base.outside.refusal import check_names
from cloudrc.base.outside.tables import SECONDS
from cloudrc.base.outside.values import ANY, Quantity
from cloudrc.base.plugins import is_path, signature
from cloudrc.config.compute import read_times
from cloudrc.flight.trials.tables import CSV, PARQUET
from cloudrc.gym.options import ANSWER
from cloudrc.link.library import read_profile
from cloudrc.studies.eval.setup import FILE, MEASURED, SEED, Compute, SharedChannel, radio_ms
from cloudrc.studies.policy.observation import Mapped

TABLE_BEGINS = {CSV: b"key,", PARQUET: b"PAR1"}
"""Ending of a file of rows -> how its content begins."""
COMPUTE = Quantity("s", 0, 3600)
"""Time for an answer."""


def check_policy(policy: str) -> None:
    """Raise a BadInputError if the policy cannot be used."""
    if "://" in policy:
        try:
            check_url(policy)
        except ValueError as error:
            raise BadInputError(f"--policy: {error}") from None
    elif not is_path(policy) or not Path(policy).is_file():
        raise BadInputError(
            f"--policy {policy}: there is no such file; give a Python file, such as "
            "./expert.py, or the address of a server, such as ws://127.0.0.1:8000"
        )


def check_rows(path: Path | None) -> None:
    """Check that a file for the rows of the episodes is new, or one of an earlier call."""
    if path is None:
        return
    what, begin = f"--rows {path}", TABLE_BEGINS.get(path.suffix)
    if begin is None:
        raise BadInputError(f"{what}: name a file that ends in {' or '.join(TABLE_BEGINS)}")
    if path.suffix == PARQUET and not find_spec("pyarrow"):
        raise MissingPrerequisiteError(f"{what}: needs pyarrow; run: pip install pyarrow")
    if not path.parent.is_dir():
        raise BadInputError(f"{what}: there is no folder {path.parent}; make it, or name another")
    if path.is_file():
        with path.open("rb") as file:
            is_ours = file.read(len(begin)) == begin
        if not is_ours:
            check_new(path, "name another file with --rows")


def check_round_trips(profile: str, round_trips: tuple[float | None, ...]) -> None:
    """Raise a BadInputError if the link has no constant delays that `round_trips` [ms] replace."""
    link = read_profile(profile)
    if round_trips != (None,) and any(
        way.rows or way.changes for way in (link.uplink, link.downlink)
    ):
        raise BadInputError(
            f"--rtt: the delays of the profile '{profile}' change over time; leave --rtt out, or "
            "choose a profile with constant delays"
        )
    given, least = [each for each in round_trips if each is not None], radio_ms(link)
    if min(given, default=least) < least:
        raise BadInputError(
            f"--rtt: the radio of the profile '{profile}' alone takes {least:.4g} ms; give more"
        )


def read_compute(text: str) -> tuple[Compute, tuple[float, ...]]:
    """Read the time for an answer: a number [s], "MEAN,DEVIATION" [s], "measured", or a file.

    Also return the times that a file has [s]; the head of its column says the unit.
    """
    if text == MEASURED:
        return (MEASURED, ""), ()
    try:
        numbers = [ANY.read(each) for each in text.split(",")]
    except ValueError:
        if os.path.lexists(text):
            return (FILE, text), read_times(Path(text), f"--compute {text}", SECONDS, COMPUTE)
        numbers = []
    if len(numbers) not in (1, 2) or not all(COMPUTE.ge <= each <= COMPUTE.le for each in numbers):
        raise BadInputError(
            f"--compute {text}: give the time for an answer: a number of s such as 0.05, "
            f"MEAN,DEVIATION in s, the path of a file that exists, or '{MEASURED}'"
        )
    return (numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])), ()


def read_env_args(texts: list[str]) -> tuple[tuple[str, Any], ...]:
    """Read arguments of an environment, given as KEY=VALUE; a value is YAML, also with None."""
    return tuple(sorted(_pairs("--env-arg", texts, "env_name=reach-v3").items()))


def read_start(text: str) -> Any:
    """Read the action before the first answer: None, ANSWER, or a number or a list."""
    value = None if text == "none" else parse_value(text, "--start")
    if isinstance(value, str) and value != ANSWER:
        raise BadInputError(
            f"--start {text}: give '{ANSWER}', 'none', or an action such as 0 or [0.5, 0]"
        )
    return value


def read_parameters(
    texts: list[str], executors: list[str]
) -> dict[str, tuple[tuple[str, Any], ...]]:
    """Read parameters of executors, given as KEY=VALUE: executor -> those that it has."""
    given = _pairs("--set", texts, "share=.5")
    known: dict[str, Collection[str]] = dict.fromkeys(executors, ())
    if given:
        from cloudrc.gym.options import full_name  # here, because it imports gymnasium

        known = {each: signature("executors", full_name(each)).parameters for each in executors}
    check_names("parameter", given, [key for each in known.values() for key in each], "--set: ")
    return {
        each: tuple((key, value) for key, value in given.items() if key in known[each])
        for each in executors
    }


def _pairs(flag: str, texts: list[str], example: str) -> dict[str, Any]:
    """Read KEY=VALUE: key -> value."""
    found = dict[str, Any]()
    for text in texts:
        key, equals, value = text.partition("=")
        if not (equals and key.isidentifier()):
            raise BadInputError(f"{flag} {text}: give KEY=VALUE, such as {example}")
        value = "null" if value == "None" else value
        found[key] = value if value == SEED else parse_value(value, f"{flag} {key}")
    return found


def read_codec(text: str | None, observation_bytes: int | None) -> str | None:
    """Check a codec of images; the size of an observation is then not to be said."""
    if text is None:
        return None
    from cloudrc.gym import options  # here, because it imports gymnasium

    options.read_codec(text, "--codec")
    if observation_bytes is not None:
        raise BadInputError(
            "--codec says how large an observation is; leave --observation-bytes out"
        )
    return text


def read_channel(path: Path | None, robots: int) -> SharedChannel | None:
    """Read the file of a channel that so many `robots` share."""
    if (path is None) != (robots == 1):
        raise BadInputError("give --robots, the number of robots, and --channel, what they share")
    if path is None:
        return None
    tree = read_document(path, path.name).tree
    check_names("key", tree, SharedChannel._fields, f"{path}: ")
    found = SharedChannel(**tree)
    if not isinstance(found.schedule, str):
        raise BadInputError(f"{path}: schedule: give a name, or the path of a file")
    if is_path(found.schedule):  # beside the file that names it
        found = found._replace(schedule=os.path.join(path.parent, found.schedule))
    return found


def read_mapped(path: Path | None) -> tuple[Mapped, ...]:
    """Read the map from an environment's observation to that of a policy; () without a file."""
    if path is None:
        return ()
    found, example = list[Mapped](), "observation/state: agent_pos, or prompt: {value: go}"
    for key, value in read_document(path, path.name).tree.items():
        if isinstance(value, str) and value:
            found.append(Mapped(str(key), value))
        elif isinstance(value, Mapping) and value.keys() == {"value"}:
            found.append(Mapped(str(key), None, value["value"]))
        else:
            raise BadInputError(
                f"{path}: {key}: give the place in the environment's observation, or a value; for "
                f"example {example}"
            )
    if not found:
        raise BadInputError(f"{path}: has no keys; for example {example}")
    return tuple(found)
