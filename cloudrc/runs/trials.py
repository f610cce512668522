"""Try values of a key: is the loop stable with a value, and do the flights settle in time?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from typing import Any, NamedTuple, TypeAlias

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.errors import BadInputError
from cloudrc.runs import flight, stability
from cloudrc.runs.experiment import check_world, load, refuse_seed
from cloudrc.runs.margin import (
    LIMIT_MAX,
    STEPS_MAX,
    ValueRange,
    bisect,
    check_largest,
    limits,
    present_value,
    search,
)
from cloudrc.runs.stability import LARGE
from cloudrc.runs.workers import map_in_order

QUESTIONS = {
    "stable": "is the loop stable? a step of {small:g} m per axis in the scene {scene}",
    "settles": "does it settle in time? flights of {experiment}",
}
"""Name of a question -> the question in words."""
NOT_IN_STEP = "mission.", "criteria.", "report."
"""Keys that begin so do not change the step, so that stability does not depend on them."""

Trial: TypeAlias = dict[str, Any]
"""Result of the flights with one value: `value`, the guard's `speed_max_mps`, and the answer as
`stable` or `settles`; for a constant delay `rtt_ms`; after a failure `code`, `text` and `seed`."""


class Asked(NamedTuple):
    """The question of `cloudrc margin`: which key is tried, with which flights."""

    key: str  # key of the experiment whose value is a number
    experiment: str  # name of a shipped experiment, or path of a YAML file
    settings: Sequence[str]  # KEY=VALUE
    seeds: int  # the flights have the seeds 1 to `seeds`
    max: float | None = None  # largest value to try [any unit: that of the key]
    resolution: float | None = None  # try multiples of this value [any unit: that of the key]


class Trials:
    """The values of the key that are tried, each at most once per question.

    Attributes:
        size: All values are multiples of this one.
        present: The number of the first value: the value divided by `size`.
        bottom: Number of the smallest value that is tried.
        top: Number of the largest value that is tried.
        top_why: Why no larger value is tried, in words.
        step_depends: Whether the response to a step depends on the key.
    """

    def __init__(self, asked: Asked) -> None:
        """Read the present value and the range of the search; refuse a key that has no range."""
        self.asked = asked
        key = asked.key
        refuse_seed([*asked.settings, f"{key}=0"])
        self.step_depends = not key.startswith(NOT_IN_STEP)
        now = present_value(load(asked.experiment, asked.settings), key)
        first = asked.max if now is None else now
        if asked.max is not None:
            check_largest(key, asked.max)
        elif first is None:
            load(asked.experiment, [*asked.settings, f"{key}=1"])  # names an unknown key
            raise BadInputError(f"{key}: has no value now; name the largest one to try with --max")
        self.size = 1.0 if isinstance(now, int) else 0.01
        if key.endswith("_ms"):
            self.size = 10.0
        if asked.resolution is not None:
            self.size = asked.resolution
        elif asked.max is not None and not isinstance(now, int):
            while 0 < asked.max < self.size:  # the default fits the range
                self.size /= 10.0
        # Without a value the key has no effect, as a large value has: begin there.
        self.present = self._number(1.0 if first is None else first)
        given = STEPS_MAX * self.present * self.size if asked.max is None else asked.max
        if not 0 < self.size <= given < math.inf:
            if asked.max is None:
                raise BadInputError(f"--resolution {self.size:g} must be a finite number above 0")
            if asked.resolution is None:
                least = f"at least {self.size:g}" if 0 < given < 1 else "a finite number above 0"
                raise BadInputError(f"--max {given:g} must be {least}")
            raise BadInputError(
                f"--resolution {self.size:g} must be above 0, --max {given:g} not below it"
            )
        self._done: dict[tuple[str, int], Trial] = {}
        self._ready: dict[int, tuple[ResolvedExperiment | None, str]] = {}
        self._find_range(math.floor(given / self.size + 1e-9))

    def _number(self, value: float) -> int:
        return max(1, round(value / self.size)) if 0 < self.size < math.inf else 1

    def _find_range(self, top: int) -> None:
        """Limit the search to values that the experiment allows, around the present one."""

        def allowed(number: int) -> bool:
            return self.experiment(number)[0] is not None

        self.present = min(self.present, top)
        if not allowed(self.present):
            raise BadInputError(self.experiment(self.present)[1])
        self.top, self.bottom = top, 1
        self.top_why = "the largest value tried; raise --max"
        if not allowed(top):
            self.top, beyond = bisect(allowed, self.present, top)
            self.top_why = f"the largest value possible: {self.experiment(beyond)[1]}"
        if not allowed(1):
            self.bottom, _ = bisect(allowed, self.present, 1)

    def value(self, number: int | None) -> float | None:
        """Return the value of a number; None for None."""
        return None if number is None else round(number * self.size, 9)

    def experiment(self, number: int) -> tuple[ResolvedExperiment | None, str]:
        """Return the experiment with a value, and limits that fit; or why there is none."""
        if number not in self._ready:
            self._ready[number] = self._prepare(number)
        return self._ready[number]

    def _prepare(self, number: int) -> tuple[ResolvedExperiment | None, str]:
        asked = self.asked
        settings = [*asked.settings, f"{asked.key}={self.value(number):.12g}"]
        try:
            experiment = load(asked.experiment, settings)
            check_world(experiment.world, turns=experiment.mission.turns)
        except BadInputError as error:
            return None, str(error)
        given = [text.partition("=")[0].strip() for text in settings]
        if asked.key == "guard.speed_max_mps":  # a longer limit would lower the largest speed
            given.append("guard.command_age_max_ms")
        more, needed = limits(experiment, given, asked.seeds)
        if needed > LIMIT_MAX and "guard.command_age_max_ms" not in given:
            age = f"a command would be {needed:g} s old"
            age = age if needed < math.inf else "no command arrives within 20 s"
            return None, f"{age}, and guard.command_age_max_ms ends at {LIMIT_MAX:g} s"
        return (load(asked.experiment, [*settings, *more]) if more else experiment), ""

    def search(
        self, question: str, see: Callable[[int, Trial], None] = lambda number, trial: None
    ) -> ValueRange:
        """Find the range of values in which the answer to a question is yes.

        Call `see` with the number of each value that is tried, and its trial.
        """

        def works(number: int) -> bool:
            trial = self._try(question, number)
            see(number, trial)
            return bool(trial[question])

        return search(works, self.present, self.bottom, self.top)

    def trial(self, question: str, number: int) -> Trial:
        """Return a trial that has been flown."""
        return self._done[question, number]

    def trials(self, question: str) -> list[Trial]:
        """Return all trials of a question, the smallest value first."""
        return [self._done[key] for key in sorted(self._done) if key[0] == question]

    def _try(self, question: str, number: int) -> Trial:
        if (question, number) not in self._done:
            experiment, why = self.experiment(number)
            trial: Trial = {"value": self.value(number), question: experiment is not None}
            if experiment is None:
                trial |= {"code": "refused", "text": why}
            else:
                if (rtt := self._round_trip(experiment)) is not None:
                    trial["rtt_ms"] = rtt
                trial["speed_max_mps"] = experiment.guard.speed_max_mps
                ask = _ask_stable if question == "stable" else _ask_settles
                trial |= self._fly(experiment, ask, question)
            self._done[question, number] = trial
        return self._done[question, number]

    def _fly(
        self, experiment: ResolvedExperiment, ask: Callable[..., Iterable[Trial]], question: str
    ) -> Trial:
        """Fly one seed after the other, until an answer is no; return what is new in the trial."""
        seeds = range(1, self.asked.seeds + 1)
        jobs = [experiment.model_copy(update={"seed": seed}) for seed in seeds]
        result: Trial = {}
        for seed, answer in zip(seeds, ask(jobs), strict=False):
            result = answer
            if not answer[question]:
                return result | {"seed": seed}
        return result

    def large_step(self, value: float | None) -> Trial:
        """Fly a step of 1 m per axis at the stable `value` [any unit]; {} if it is None."""
        experiment = None if value is None else self.experiment(self._number(value))[0]
        if experiment is None:
            return {}
        found = stability.fly_step(experiment.model_copy(update={"seed": 1}), LARGE)
        return {"size_m": LARGE, "speed_max_mps": experiment.guard.speed_max_mps, **found}

    def name(self, number: int) -> str:
        """Return the value of a number with its unit and, for a delay, the round trip."""
        experiment, _ = self.experiment(number)
        rtt = None if experiment is None else self._round_trip(experiment)
        text = f"{self.value(number):.12g}{' ms' if self.asked.key.endswith('_ms') else ''}"
        return text if rtt is None else f"{text} (RTT {rtt:g} ms)"

    def _round_trip(self, experiment: ResolvedExperiment) -> float | None:
        """Return the round trip for a key that is a delay [ms]; None if it changes in flight."""
        ways = experiment.uplink, experiment.downlink
        if not self.asked.key.endswith("delay_ms") or any(way.trace or way.changes for way in ways):
            return None
        return sum(way.delay_ms for way in ways)


def questions(trials: Trials) -> list[str]:
    """Return the questions whose answer may depend on the key."""
    return [name for name in QUESTIONS if name == "settles" or trials.step_depends]


def describe(trials: Trials, found: Mapping[str, ValueRange | None]) -> dict[str, Any]:
    """Return the result as values for JSON; `found`: question -> range, or None if not asked."""
    asked = trials.asked
    document: dict[str, Any] = {
        **{"key": asked.key, "experiment": asked.experiment},
        **{"overrides": list(asked.settings), "seeds": asked.seeds, "resolution": trials.size},
        **{"smallest": trials.value(trials.bottom), "largest": trials.value(trials.top)},
        "largest_why": trials.top_why,
    }
    for name, each in found.items():
        document |= _entries(name, each, trials)
    if large := trials.large_step(document["stable_up_to"]):
        document["large_step"] = large
    return document


def _ask_stable(jobs: list[ResolvedExperiment]) -> Iterable[Trial]:
    # A worker takes as long to start as some flights.
    with closing(map_in_order(stability.fly_step, jobs, len(jobs) // 4)) as answers:
        yield from answers


def _ask_settles(jobs: list[ResolvedExperiment]) -> Iterable[Trial]:
    with closing(map_in_order(flight.fly_point, jobs, len(jobs) // 4)) as flights:
        for row in flights:
            if row["verdict"] == "success":
                yield {"settles": True}
            else:
                code = (*row["failures"], row["verdict"])[0]
                yield {"settles": False, "code": code, "text": row["text"]}


def _entries(name: str, found: ValueRange | None, trials: Trials) -> dict[str, Any]:
    """Return the part of the document about one question; `found` is None if it is not asked."""
    if found is None:
        return {f"{name}_up_to": None, f"{name}_trials": []}
    elsewhere = [[trials.value(a), trials.value(b)] for a, b in found.elsewhere]
    return {
        f"{name}_from": trials.value(found.first),
        f"{name}_up_to": trials.value(found.last),
        f"{name}_fails_below": trials.value(found.below),
        f"{name}_fails_at": trials.value(found.above),
        f"{name}_elsewhere": elsewhere,
        f"{name}_trials": trials.trials(name),
    }
