# SPDX-License-Identifier: Apache-2.0

"""Play what an entry needs: each condition with each seed, by the engines that are there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any

from cloudrc.base import source
from cloudrc.base.errors import CloudrcError
from cloudrc.base.outside.code import sources
from cloudrc.base.outside.reuse import reuse_results
from cloudrc.base.plugins import is_path
from cloudrc.base.requirements import EXTRAS
from cloudrc.flight.experiment import load
from cloudrc.flight.own_files import hash_of
from cloudrc.flight.trials.fingerprint import experiment_facts, fingerprint
from cloudrc.flight.trials.plan import PlannedFlight
from cloudrc.flight.trials.play import Trial, run
from cloudrc.flight.trials.rows import Row, Rows
from cloudrc.results.report.document import versions
from cloudrc.studies.eval.episode import AskedPolicy, asking, check_environment, make_env
from cloudrc.studies.eval.provenance import LIBRARIES, provenance
from cloudrc.studies.eval.results import EpisodeTrial
from cloudrc.studies.eval.setup import BASELINE, Episode, EvalSetup
from cloudrc.studies.policy.observation import STATE, WHOLE, Mapped
from cloudrc.studies.rank.entry import FAILED, write_entry
from cloudrc.studies.rank.score import score
from cloudrc.studies.rank.tasks import (
    CONDITIONS,
    CONSTANT,
    NONE,
    SEEDS,
    TASKS,
    VERSION,
    Entrant,
    pinned,
)

Condition = tuple[str, float | None]
"""Link and round trip [ms]; None: that of the link."""
Shard = tuple[int, int] | None
"""Number of a part of the episodes, from 1, and how many parts there are; None: all."""
ANSWERS = 20
"""Answers whose time is measured."""


class Played:
    """The episodes of an entry, those that are missing and those that were played."""

    def __init__(self, entrant: Entrant, path: Path) -> None:
        """Make the environment and the policy once; `path` is the file of the entry."""
        self.entrant, self._path = entrant, path
        self.rows_folder = path.with_suffix(".rows")
        task = TASKS[entrant.task]
        self.setup = EvalSetup(
            task.env or task.experiment,
            entrant.path,
            task.env_args,
            mapped=(Mapped(STATE, WHOLE), Mapped("prompt", None, entrant.task)),
            success_at=task.success_at,
            max_steps=task.max_steps,
        )
        if task.env:
            self.setup, _ = check_environment(self.setup, [Episode(0.0, entrant.executor, 1)])
        with reuse_results():  # files are hashed once
            make = _episodes if task.env else _flights
            self.trials = {each: [*make(self.setup, entrant, *each)] for each in CONDITIONS}

    def __len__(self) -> int:
        return len(self._by_key())

    def _by_key(self) -> dict[str, Trial]:
        return {trial.key: trial for some in self.trials.values() for trial in some}

    def play(self, jobs: int, shard: Shard, see: Callable[[int], None]) -> CloudrcError | None:
        """Play what is missing; return why the work ended early, or None.

        `see` gets the number of episodes that have a row.

        Raises:
            PolicyFailedError: If the policy gave a wrong answer, or none.
        """
        self.rows_folder.mkdir(parents=True, exist_ok=True)
        number, parts = shard or (1, 1)
        mine = [*self._by_key().values()][number - 1 :: parts]
        rows = Rows(self.rows_folder, shard and number)
        done = count(sum(each.key in rows.kept for each in mine))
        see(next(done))
        jobs = 1 if self.setup.is_remote else jobs  # a server may serve one episode at a time
        return run(mine, rows, jobs, lambda row: see(next(done)))

    def write(self, failed: str = "") -> dict[str, Any]:
        """Write the file of the entry; `failed` says why the policy cannot be scored."""
        rows = Rows(self.rows_folder).kept
        results = [] if failed else [_result(rows, *each) for each in self.trials.items()]
        entrant, own = self.entrant, self.setup.policy
        failed = failed.replace(own, entrant.policy)  # no path of this machine
        made = provenance(self.setup, entrant.command)
        packages = [module for each in entrant.extras for module in EXTRAS[each]]
        loaded = [each for each in (*LIBRARIES, *packages) if find_spec(each)]
        content = {
            "schemaVersion": 1,
            "rank": VERSION,
            "task": entrant.task,
            "policy": entrant.policy,
            "executor": entrant.executor,
            **(score(results) if results else FAILED),
            "failed": failed,
            "answer": "" if failed else self._time_of_answer(),
            "hashes": {
                **pinned(entrant.task),
                "policy": hash_of(sources(Path(own))) if is_path(own) else own,
            },
            "results": results,
            "code": source.code_hash(),
            "versions": {"python": made["versions"]["python"], **versions(["cloudrc", *loaded])},
            "command": made["command"],
            "date": made["date"].partition(" ")[0],
            "cite": made["cite"],
        }
        return write_entry(self._path, content)

    def _time_of_answer(self) -> str:
        """Measure how long an answer takes here, in words: a power of ten."""
        if not TASKS[self.entrant.task].env:
            return "-"
        times = list[float]()
        with make_env(self.setup, 1) as env, asking(self.setup) as ask:
            seen, _ = env.reset(seed=1)
            policy = AskedPolicy(ask, self.setup, env.action_space)
            for _ in range(ANSWERS):
                policy(seen)
                times.append(1e3 * policy.duration)
        bound = next((each for each in (1, 10, 100, 1000) if median(times) < each), None)
        return "1 s or more" if bound is None else f"below {bound} ms"


def _episodes(
    setup: EvalSetup, entrant: Entrant, link: str, rtt_ms: float | None
) -> Iterator[Trial]:
    """Yield the episodes of a condition."""
    executor = BASELINE if link == NONE else entrant.executor
    setup = setup if link in (NONE, CONSTANT) else replace(setup, link=link)
    identity = setup.identity()
    for seed in SEEDS:
        episode = Episode(rtt_ms, executor, seed)
        yield EpisodeTrial(episode.key(identity), episode, setup)


def _flights(
    setup: EvalSetup, entrant: Entrant, link: str, rtt_ms: float | None
) -> Iterator[Trial]:
    """Yield the flights of a condition; without a network is over the link `ideal`."""
    name = "ideal" if link in (NONE, CONSTANT) else link
    texts = [f"link.profile={name}", f"cloud.perception={setup.policy}"]
    texts += [f"cloud.predictor={entrant.executor}"]
    texts += [f"link.both.delay_ms={rtt_ms / 2:g}"] if rtt_ms else []
    resolved = load(setup.env, texts)
    facts = fingerprint(experiment_facts(resolved))
    for seed in SEEDS:
        yield PlannedFlight(facts, {"link": name, "rtt_ms": rtt_ms or 0.0}, seed, resolved)


def _result(
    rows: Mapping[str, Row], condition: Condition, trials: Sequence[Trial]
) -> dict[str, Any]:
    """Return what an entry says about a condition."""
    found = [rows[each.key] for each in trials]
    digest = sha256("".join(each["records_sha256"] for each in found).encode())
    return {
        "link": condition[0],
        "rtt_ms": condition[1],
        "success": "".join(str(int(each["verdict"] == "success")) for each in found),
        "records_sha256": digest.hexdigest(),
    }
