# SPDX-License-Identifier: Apache-2.0

"""Play the episodes of an evaluation, keep their rows, and summarise them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base import source
from cloudrc.base.errors import CloudrcError
from cloudrc.base.files import read_json, write_json
from cloudrc.base.outside.reuse import reuse_results
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.statistics import LEVEL
from cloudrc.base.text import cells, table
from cloudrc.flight.trials.play import run
from cloudrc.flight.trials.rows import Row, Rows, read_rows
from cloudrc.flight.trials.tables import columns_of, write_table
from cloudrc.studies.eval.episode import play as play_alone
from cloudrc.studies.eval.robots import play as play_together
from cloudrc.studies.eval.setup import Episode, EvalSetup

FILE = "eval.json"
"""File in the folder of an evaluation: what it plays, and the summary of its rows."""
SEEDLESS = (
    "the environment begins differently with the same seed, so that the conditions are not paired; "
    "if it takes a seed, add --env-arg 'seed={seed}'"
)
"""Warning about an environment that does not follow the seed of its reset."""
PAIRED = (
    "env",
    "env_args",
    "env_code",
    "link",
    "success_at",
    "dt",
    "max_steps",
    "code",
    "answer_within",
    "observation_bytes",
    "delivery",
    "packet_bytes",
    "start",
    "hold",
    "robots",
    "channel",
    "schedule",
    "codec",
)
"""What two evaluations must share for a comparison of their policies."""
FLAGS = {"delivery": "--delivery", "packet_bytes": "--packet-bytes", "codec": "--codec"}
"""Of these, how the flags are called that people have to give."""
LEGEND = (
    "loop: time from an observation to its action; ended: terminated/truncated/by --max-steps; "
    "held: steps without a\nnew action; age: of the observation behind an action, in so many "
    "steps; worst: of any 10 steps,\nthe most that were held or late"
)
COLUMNS = {
    "round trip": "{rtt_ms:g} ms",
    "loop": "{loop_age_ms:.0f} ms",
    "executor": "{executor}",
    "on link": "{observation_bytes:,} B, {on_link_ms:g} ms",
    "shown": "{frames_shown:.1%}",
    "return": "{return:.5g}",
    "95 %": "{return_low:.5g} .. {return_high:.5g}",
    "success": "{successes}/{episodes}",
    "95 % ": "{success_low:.0%} .. {success_high:.0%}",
    "steps": "{steps:g}",
    "ended": "{terminated}/{truncated}/{limit}",
    "held": "{stale_share:.1%}",
    "age": "{action_age_ms:.0f} ms",
    "p99": "{action_age_p99_ms:.0f} ms",
    "late": "{late_share:.1%}",
    "of steps": "{action_age_of:.0f}",
    "worst": "{misses_in_10:g}/10",
}
"""Head -> cell of the table of outcomes."""
TESTS = {
    "round trip": "{rtt_ms:g} ms",
    "A": "{a}",
    "B": "{b}",
    "A only": "{success[only_a]}",
    "B only": "{success[only_b]}",
    "p": "{success[p_mcnemar]:.2g}",
    "p Holm": "{success[p_holm]:.2g}",
    "return B - A": "{return[difference]:.4g}",
    "p ": "{return[p_wilcoxon]:.2g}",
    "p Holm ": "{return[p_holm]:.2g}",
}
"""Head -> cell of the table of tests."""


TIMES = ("age", "delay", "budget")
"""Words in the names of numbers that are times."""
FLAT = ("seed", "verdict", "ended", "link_start", "records_sha256", "code")
"""Fields of a row that a flat line has beside its condition and its numbers."""


def is_begun(folder: Path) -> bool:
    """Return whether a folder has an evaluation."""
    return (folder / FILE).is_file()


def check_folder(folder: Path, setup: EvalSetup) -> None:
    """Raise an error if a folder has the evaluation of another environment or policy.

    A policy is another one if its file has another place: of a file that has changed, the episodes
    are missing.
    """
    had, now = _read(folder), setup.identity()
    same = all(had["identity"][name] == now[name] for name in ("env", "env_args"))
    if not same or _place(had["policy"]) != _place(setup.policy):
        text = f"has the episodes of {had['env']} with {had['policy']}"
        raise InvalidValueError(f"{text}, or of other arguments; name a new folder")


def _read(folder: Path) -> dict[str, Any]:
    """Return the content of the file of an evaluation."""
    found = read_json(folder / FILE)
    if "env" not in found.get("identity", ()):
        raise InvalidValueError(f"its {FILE} is of no evaluation")
    return found


def _place(policy: str) -> str:
    return policy if "://" in policy else os.path.abspath(policy)


class Before(NamedTuple):
    """What earlier calls have left in a folder."""

    versus: str = ""  # folder of the evaluation with which the page compares
    seeds: tuple[int, ...] = ()  # different numbers of seeds of the same evaluation


def read_before(folder: Path, setup: EvalSetup) -> Before:
    """Return what earlier calls have left in a folder; seeds of other episodes do not count."""
    had = _read(folder)
    is_same = had["identity"] == setup.identity()
    return Before(had.get("versus", ""), tuple(had.get("seeds", ())) if is_same else ())


class EpisodeTrial(NamedTuple):
    """An episode of an evaluation."""

    key: str
    episode: Episode
    setup: EvalSetup
    keep: Path | None = None  # file for its timeline; None: none

    def play(self) -> Row:
        """Play it; return its row."""
        play = play_together if self.setup.channel else play_alone
        return play(self.episode, self.setup, self.key, self.keep)


def play_missing(
    folder: Path,
    setup: EvalSetup,
    episodes: Sequence[Episode],
    jobs: int,
    known: Before,
    see: Callable[[int], None],
    *,
    keep: bool = False,
) -> tuple[list[Row], CloudrcError | None]:
    """Play the episodes without a row in `folder`; return the rows of all, and why it ended early.

    `see` gets the number of episodes that have a row, at the beginning and after each one. The
    file of the folder gets what is `known`. With `keep`, each episode that is played leaves a file
    in the folder's `timelines`.

    Raises:
        CloudrcError: If environment or policy fail; the rows before are kept.
    """
    rows, identity = Rows(folder), setup.identity()
    timelines = folder / "timelines" if keep else None
    if timelines:
        timelines.mkdir(exist_ok=True)
    write(folder, setup, known._asdict())
    with reuse_results():  # the code of an executor is that of all its episodes
        trials = [
            EpisodeTrial(each.key(identity), each, setup, timelines and timelines / each.file)
            for each in episodes
        ]
    done = count(sum(each.key in rows.kept for each in trials))
    see(next(done))
    # A server may serve one episode at a time.
    jobs = 1 if setup.is_remote else jobs
    stopped = run(trials, rows, jobs, lambda row: see(next(done)))
    return [rows.kept[each.key] for each in trials if each.key in rows.kept], stopped


def write(folder: Path, setup: EvalSetup, found: Mapping[str, Any]) -> dict[str, Any]:
    """Write the file of an evaluation with what was `found`, and return its content."""
    document = {
        "schemaVersion": 1,
        "env": setup.env,
        "env_args": dict(setup.env_args),
        "policy": setup.policy,
        "link": setup.link,
        "compute": setup.compute,
        "step": setup.step and setup.step._asdict(),
        "delivery": setup.delivery,
        "packet_bytes": setup.packet_bytes,
        **setup.sent,
        **({"codec": setup.codec} if setup.codec else {}),
        "repeatable": setup.is_repeatable,
        "code": source.code_hash(),
        "identity": setup.identity(),
        **found,
    }
    write_json(folder / FILE, document)
    return document


def write_rows(path: Path, rows: Sequence[Row]) -> None:
    """Write a flat line per episode into a CSV or Parquet file; times are in s."""
    columns = columns_of(rows, ("rtt_ms", "executor"), FLAT)
    times = [name for name in columns if any(word in name for word in TIMES)]
    units = {name: "s" for name in (*times, "link_start") if not name.endswith("_of")}
    write_table(path, columns, units)


def read_versus(folder: Path, setup: EvalSetup, episodes: Sequence[Episode]) -> list[Row]:
    """Return the rows of the same episodes in the folder of another policy's evaluation.

    Raise an error if more differs than the policy and its time for an answer.
    """
    had = _read(folder)
    before = {**had["identity"], "code": had["code"]}
    now = {**setup.identity(), "code": source.code_hash()}
    if other := [name for name in PAIRED if before.get(name) != now.get(name)]:
        told = ", ".join(FLAGS.get(name, name) for name in other)
        hint = f" (it has --delivery {before.get('delivery')})" * ("delivery" in other)
        raise InvalidValueError(f"differs in {told}{hint}; evaluate it again")
    rows = read_rows(folder)
    return [rows[key] for each in episodes if (key := each.key(had["identity"])) in rows]


def describe_success(setup: EvalSetup, outcomes: Sequence[Mapping[str, Any]]) -> str:
    """Say in words what counts as a success."""
    of_all, means = "", ""
    if setup.channel:
        of_all, means = (
            f", for each of {setup.robots} robots",
            "; numbers are means over the robots",
        )
    if setup.success_at is not None:
        return f"a return of at least {setup.success_at:g}{of_all}{means}"
    if any("successes" not in each for each in outcomes):
        return f"unknown: the environment's info has no success; the return is measured{means}"
    return f"the environment's info says success in some step{of_all}{means}"


def as_text(document: Mapping[str, Any]) -> str:
    """Return the content of the file for people.

    Of the tests, only those that decide by Holm's p are shown, unless another policy was named.
    """
    columns, outcomes = dict(COLUMNS), document["outcomes"]
    if "success" in outcomes[0]:
        del columns["95 %"]  # to keep the lines short
    decided = [
        each
        for each in document["tests"]
        if document["versus"]
        or any(each[name]["p_holm"] < LEVEL for name in ("return", "success") if name in each)
    ]
    tables = [cells(outcomes, columns), *([cells(decided, TESTS)] if decided else [])]
    shown, *more = (table(each, right=range(len(each[0]))) for each in tables)
    success = f"success: {document['success']}"
    return "\n".join([shown, "", LEGEND, success, "", *more, *document["notes"]])
