"""Play the episodes of an evaluation, keep their rows, and summarise them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any, NamedTuple

from cloudrc.config.reuse import reuse_results
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.eval.episode import play
from cloudrc.eval.setup import Episode, EvalSetup
from cloudrc.files import read, write_atomically
from cloudrc.rounding import format_limit
from cloudrc.runs.store import append_rows, read_rows
from cloudrc.runs.workers import map_in_order, take_each
from cloudrc.source import code_hash
from cloudrc.statistics import exact_interval, median_interval
from cloudrc.text import format_number, table

FILE = "eval.json"
"""File in the folder of an evaluation: what it plays, and the summary of its rows."""
SEEDLESS = (
    "the environment begins differently with the same seed, so that the conditions are not paired; "
    "if it takes a seed, add --env-arg 'seed={seed}'"
)
"""Warning about an environment that does not follow the seed of its reset."""
AVERAGED = {
    "stale_share": "steps without a new action",
    "observation_age": "age of the observation",
    "action_age": "age of the action's observation",
    "seam_jump": "jump between answers",
    "delay_measured_uplink": "delay up",
    "delay_measured_downlink": "delay down",
    "loss_uplink": "loss up",
    "loss_downlink": "loss down",
}
"""Number of a row whose mean a summary has -> what it is."""
Row = dict[str, Any]


class EvalOutcome(NamedTuple):
    """The episodes of one condition, summarised."""

    rtt_ms: float | None  # mean round trip [ms]; None: that of the profile
    executor: str
    episodes: int
    successes: int | None  # None: nothing tells what a success is
    success_interval: tuple[float, float] | None  # 95 %, Clopper and Pearson [1]
    total: float  # median of the returns [1]
    total_interval: tuple[float, float] | None  # 95 % interval of the median [1]
    means: dict[str, float]  # number -> mean over the episodes


def is_begun(folder: Path) -> bool:
    """Return whether a folder has an evaluation."""
    return (folder / FILE).is_file()


def refuse_other(folder: Path, setup: EvalSetup) -> None:
    """Raise a BadInputError if a folder has the evaluation of another environment or policy.

    A policy is another one if its file has another place: of a file that has changed, the episodes
    are missing.
    """
    try:
        had = json.loads(read(folder / FILE))
        words = [had["env"], *(f"{key}={value}" for key, value in had["env_args"].items())]
        same = had["env_args"] == json.loads(json.dumps(dict(setup.env_args)))
        same = same and had["env"] == setup.env and _place(had["policy"]) == _place(setup.policy)
    except (KeyError, TypeError, ValueError, AttributeError):
        raise BadInputError(
            f"--out {folder}: its {FILE} is of no evaluation; name a new folder"
        ) from None
    if not same:
        raise BadInputError(
            f"--out {folder}: has the episodes of {' '.join(words)} with {had['policy']}; name a "
            "new folder"
        )


def _place(policy: str) -> str:
    return policy if "://" in policy else os.path.abspath(policy)


def play_missing(
    folder: Path,
    setup: EvalSetup,
    episodes: Sequence[Episode],
    jobs: int,
    see: Callable[[int], None] = lambda done: None,
) -> tuple[list[Row], CloudrcError | None]:
    """Play the episodes without a row in `folder`; return the rows of all, and why it ended early.

    `see` gets the number of episodes that have a row, at the beginning and after each one.

    Raises:
        BadInputError: If the folder has rows of other code, or the environment fails.
        CloudrcError: If the policy fails; the rows before are kept.
    """
    identity = setup.identity()
    rows = read_rows(folder)
    if other := {row.get("code") for row in rows.values()} - {code_hash()}:
        raise BadInputError(
            f"{folder}: has episodes of code {other.pop()}, this is code {code_hash()}; name a new "
            "folder with --out"
        )
    write(folder, setup, [])
    with reuse_results():  # the code of an executor is that of all its episodes
        keys = [each.key(identity) for each in episodes]
    missing = [each for each, key in zip(episodes, keys, strict=True) if key not in rows]
    # A server may serve one episode at a time.
    jobs = 1 if setup.is_remote else jobs
    played = map_in_order(partial(play, setup=setup, identity=identity), missing, jobs)
    left = len(missing)
    see(len(episodes) - left)
    with append_rows(folder, None) as append:

        def take(row: Row) -> None:
            nonlocal left
            append(row)
            rows[row["key"]] = row
            left -= 1
            see(len(episodes) - left)

        stopped = take_each(played, take)
    return [rows[key] for key in keys if key in rows], stopped


def write(folder: Path, setup: EvalSetup, outcomes: Sequence[EvalOutcome]) -> dict[str, Any]:
    """Write the file of an evaluation, and return its content."""
    document = {
        "schemaVersion": 1,
        "env": setup.env,
        "env_args": dict(setup.env_args),
        "policy": setup.policy,
        "link": setup.link,
        "compute": setup.compute,
        "repeatable": setup.is_repeatable,
        "success": describe_success(setup, outcomes),
        "code": code_hash(),
        "outcomes": [each._asdict() for each in outcomes],
    }
    write_atomically(folder / FILE, f"{json.dumps(document, indent=2)}\n".encode())
    return document


def summarize(rows: Sequence[Row]) -> list[EvalOutcome]:
    """Summarise rows, one outcome per condition, in the order in which they first occur."""
    found = dict[tuple[float | None, str], list[Row]]()
    for row in rows:
        found.setdefault((row["point"]["rtt_ms"], row["point"]["executor"]), []).append(row)
    return [_outcome(*point, some) for point, some in found.items()]


def _outcome(rtt_ms: float | None, executor: str, rows: Sequence[Row]) -> EvalOutcome:
    numbers: list[Mapping[str, float]] = [row["numbers"] for row in rows]
    known = [each["success"] for each in numbers if "success" in each]
    successes = int(sum(known)) if len(known) == len(rows) else None
    totals, means = [each["return"] for each in numbers], dict[str, float]()
    for name in AVERAGED:
        if values := [each[name] for each in numbers if name in each]:
            means[name] = sum(values) / len(values)
    return EvalOutcome(
        rtt_ms,
        executor,
        len(rows),
        successes,
        None if successes is None else exact_interval(successes, len(rows)),
        median(totals),
        median_interval(totals),
        means,
    )


def describe_success(setup: EvalSetup, outcomes: Sequence[EvalOutcome]) -> str:
    """Say in words what counts as a success."""
    if setup.success_at is not None:
        return f"a return of at least {format_limit(setup.success_at)}"
    if outcomes and any(each.successes is None for each in outcomes):
        return "unknown: the environment's info has no success; the return is measured"
    return "the environment's info says success in some step"


def cells(outcomes: Sequence[EvalOutcome]) -> list[tuple[str, ...]]:
    """Return the table of outcomes as text, with its head."""
    head = ("round trip", "executor", "success", "95 %", "return", "95 %")
    rows: list[tuple[str, ...]] = [(*head, "no new action", "observation age", "jump")]
    for each in outcomes:
        rate, interval = "-", "-"
        if each.successes is not None and each.success_interval is not None:
            rate = f"{each.successes}/{each.episodes}"
            interval = "{:.0f}-{:.0f} %".format(*(100 * end for end in each.success_interval))
        ends = each.total_interval
        rows.append(
            (
                "profile's" if each.rtt_ms is None else f"{each.rtt_ms:g} ms",
                each.executor,
                rate,
                interval,
                format_number(each.total),
                f"{format_number(ends[0])} .. {format_number(ends[1])}" if ends else "-",
                f"{100 * each.means['stale_share']:.1f} %",
                f"{1e3 * each.means['observation_age']:.0f} ms",
                format_number(each.means["seam_jump"]) if "seam_jump" in each.means else "-",
            )
        )
    return rows


def as_text(outcomes: Sequence[EvalOutcome]) -> str:
    """Return the table of outcomes for people."""
    return table(cells(outcomes), right=(2, 4, 6, 7, 8))
