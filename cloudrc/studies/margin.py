# SPDX-License-Identifier: Apache-2.0

"""Try values of a key: is the loop stable with a value, and do the flights settle in time?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from functools import cache
from typing import Any, NamedTuple

from cloudrc.base.errors import CloudrcError
from cloudrc.base.outside.document import child
from cloudrc.config.overrides import onboard_values
from cloudrc.config.problems import problem_at
from cloudrc.config.profile import COMMAND_AGE_MS
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight import in_memory as flight
from cloudrc.flight.ages import simulate_ages
from cloudrc.flight.experiment import check_no_seed, load
from cloudrc.flight.trials.workers import map_in_order
from cloudrc.studies import stability
from cloudrc.studies.search import ValueRange, bisect, search
from cloudrc.studies.stability import LARGE

QUESTIONS = {
    "stable": "is the loop stable? a step of {small:g} m per axis in the scene {scene}",
    "settles": "does it settle in time? flights of {experiment}",
}
"""Name of a question -> the question in words."""
NOT_IN_STEP = "mission.", "criteria.", "report."
"""Keys that begin so do not change the step, so that stability does not depend on them."""
SLACK = 0.1
"""Reserve between the largest age of `simulate_ages` and the limits of cloud and guard [s]."""
LIMIT_MAX = COMMAND_AGE_MS[1] * 1e-3
"""Largest value of each of these limits [s]."""
STEPS_MAX = 32
"""Default of the largest value to try, as a multiple of the first value."""

Answer = dict[str, Any]
"""Result of the flights with one value: `value`, the guard's `speed_max_mps`, and the answer as
`stable` or `settles`; for a constant delay `rtt_ms`; after a failure `code`, `text` and `seed`."""


class Asked(NamedTuple):
    """The question of `cloudrc margin`: which key is tried, with which flights."""

    key: str  # key of the experiment whose value is a number
    experiment: str  # name of a shipped experiment, or path of a YAML file
    settings: Sequence[str]  # KEY=VALUE
    seeds: int  # the flights have the seeds 1 to `seeds`
    max: float | None = None  # largest value to try, above 0 [any unit: that of the key]
    resolution: float | None = None  # try multiples of this value, above 0 [any unit: as above]


class Margin:
    """The values of the key that are tried, each at most once per question.

    Attributes:
        size: All values are multiples of this one.
        present: The number of the first value: the value divided by `size`.
        bottom: Number of the smallest value that is tried.
        top: Number of the largest value that is tried.
        found: Question -> the range of values in which the answer is yes; None if it is not asked.
        experiment: Function from a number to the experiment with this value, or None and why there
            is none.
        top_why: Why no larger value is tried, in words.
    """

    def __init__(self, asked: Asked) -> None:
        """Read the present value and the range of the search."""
        self.asked = asked
        check_no_seed([*asked.settings, f"{asked.key}=0"])
        now = present_value(load(asked.experiment, asked.settings), asked.key)
        first = asked.max if now is None else now
        if first is None:
            load(asked.experiment, [*asked.settings, f"{asked.key}=1"])  # names an unknown key
            raise problem_at(asked.key, "has no value now; name the largest one to try with --max")
        self.size = asked.resolution or _resolution(asked, now)
        # Without a value the key has no effect, as a large value has: begin there.
        self.present = self._number(first)
        top = self.present * STEPS_MAX
        if asked.max is not None:
            top = math.floor(asked.max / self.size + 1e-9)
            if top < 1:
                raise problem_at("--max", f"{asked.max:g}: must be at least {self.size:g}")
        self.found: dict[str, ValueRange | None] = dict.fromkeys(QUESTIONS)
        self._done: dict[tuple[str, int], Answer] = {}
        self.experiment = cache(self._prepare)
        self._find_range(top)

    def _number(self, value: float) -> int:
        return max(1, round(value / self.size))

    def _find_range(self, top: int) -> None:
        """Limit the search to values that the experiment allows, around the present one."""

        def allowed(number: int) -> bool:
            return self.experiment(number)[0] is not None

        self.present = min(self.present, top)
        if not allowed(self.present):
            raise problem_at(self.asked.key, self.experiment(self.present)[1])
        self.top, self.bottom = top, 1
        self.top_why = "the largest value tried; raise --max"
        if not allowed(top):
            self.top, beyond = bisect(allowed, self.present, top)
            self.top_why = f"the largest value possible: {self.experiment(beyond)[1]}"
        if not allowed(1):
            self.bottom, _ = bisect(allowed, self.present, 1)

    @property
    def questions(self) -> list[str]:
        """The questions whose answer may depend on the key."""
        return [*QUESTIONS][self.asked.key.startswith(NOT_IN_STEP) :]

    def value(self, number: int | None) -> float | None:
        """Return the value of a number; None for None."""
        return None if number is None else round(number * self.size, 9)

    def _prepare(self, number: int) -> tuple[ResolvedExperiment | None, str]:
        """Return the experiment with a value, and limits that fit; or why there is none."""
        asked = self.asked
        settings = [*asked.settings, f"{asked.key}={self.value(number):.12g}"]
        try:
            experiment = load(asked.experiment, settings)
        except CloudrcError as error:
            return None, str(error)
        given = [text.partition("=")[0].strip() for text in settings]
        if asked.key == "guard.speed_max_mps":  # a longer limit would lower the largest speed
            given.append("guard.command_age_max_ms")
        more, needed = limits(experiment, given, asked.seeds)
        if needed > LIMIT_MAX and "guard.command_age_max_ms" not in given:
            text = f"commands are {needed:g} s old, and guard.command_age_max_ms ends at"
            return None, f"{text} {LIMIT_MAX:g} s"
        return (load(asked.experiment, [*settings, *more]) if more else experiment), ""

    def search(
        self, question: str, see: Callable[[int, Answer], None] = lambda number, answer: None
    ) -> None:
        """Find the range of values in which the answer to a question is yes: an entry of `found`.

        Call `see` with the number of each value that is tried, and the answer.
        """

        def works(number: int) -> bool:
            if (question, number) not in self._done:
                self._done[question, number] = self._ask(question, number)
            answer = self._done[question, number]
            see(number, answer)
            return bool(answer[question])

        self.found[question] = search(works, self.present, self.bottom, self.top)

    def answer(self, question: str, number: int) -> Answer:
        """Return the answer for a value that has been tried."""
        return self._done[question, number]

    def answers(self, question: str) -> list[Answer]:
        """Return all answers to a question, the smallest value first."""
        return [self._done[key] for key in sorted(self._done) if key[0] == question]

    def _ask(self, question: str, number: int) -> Answer:
        experiment, why = self.experiment(number)
        answer: Answer = {"value": self.value(number)}
        if experiment is None:
            return answer | {question: False, "code": "refused", "text": why}
        if (rtt := self._round_trip(experiment)) is not None:
            answer["rtt_ms"] = rtt
        answer["speed_max_mps"] = experiment.guard.speed_max_mps
        return answer | self._fly(experiment, question)

    def _fly(self, experiment: ResolvedExperiment, question: str) -> Answer:
        """Fly one seed after the other, until an answer is no; return what is new."""
        seeds = range(1, self.asked.seeds + 1)
        work = [experiment.model_copy(update={"seed": seed}) for seed in seeds]
        ask = stability.fly_step if question == "stable" else _ask_settles
        found: Answer = {}
        # A worker takes as long to start as some flights.
        answers = map_in_order(ask, work, len(work) // 4)
        with closing(answers):
            for seed in seeds:
                found = next(answers)
                if not found[question]:
                    found["seed"] = seed
                    break
        return found

    def large_step(self, value: float | None) -> Answer:
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
        if not self.asked.key.endswith("delay_ms") or any(
            way.trace or way.changes or way.radio for way in ways
        ):
            return None
        return sum(way.delay_ms for way in ways)


def _resolution(asked: Asked, now: float | None) -> float:
    """Return the default resolution: 10 for a key in ms, 1 for whole numbers, else 0.01 or less."""
    if asked.key.endswith("_ms"):
        size = 10.0
    else:
        size = 1.0 if type(now) is int else 0.01
    while type(now) is not int and asked.max is not None and asked.max < size:
        size /= 10.0
    return size


def _ask_settles(experiment: ResolvedExperiment) -> Answer:
    row = flight.fly_point(experiment)
    if row["verdict"] == "success":
        return {"settles": True}
    code = (*row["failures"], row["verdict"])[0]
    return {"settles": False, "code": code, "text": row["text"]}


def present_value(experiment: ResolvedExperiment, key: str) -> int | float | None:
    """Return the present value of a key; None if it is null or does not exist.

    Raise an error if the value is no number.
    """
    # The uplink's key stands for a key of both directions of the link.
    names = key.replace("link.both.", "link.uplink.").split(".")
    value: Any = experiment.model_dump(mode="json")
    if names[:2] == ["world", "onboard"]:
        value["world"]["onboard"] = onboard_values(experiment.robot, experiment.world)
    for name in names:
        value = child(value, name)
    if value is None or (isinstance(value, int | float) and not isinstance(value, bool)):
        return value
    text = "is no number; name one such as link.both.delay_ms, or an entry of a list such as"
    raise problem_at(key, f"{text} cloud.controller.gain_p.0")


def limits(
    experiment: ResolvedExperiment, given: Iterable[str], seeds: int
) -> tuple[list[str], float]:
    """Return settings KEY=VALUE that raise the time limits of cloud and guard as delays need it.

    The delays are those of the seeds 1 to `seeds`. Limits that are long enough, and limits in
    `given`, stay. The second result is the time that the limits need [s]. It may be above
    `LIMIT_MAX`, and then no setting is long enough; it is infinite if no command arrives.
    """
    longest = 0.0
    for seed in range(1, seeds + 1):
        ages, echoes = simulate_ages(experiment.model_copy(update={"seed": seed}))
        if not ages:  # no command arrives
            return [], math.inf
        longest = max(longest, *ages, *echoes)
    needed = math.ceil((longest + SLACK) * 10) / 10
    time = min(needed, LIMIT_MAX)
    cloud, guard = experiment.cloud, experiment.guard
    present = {
        "cloud.horizon_max_s": (cloud.horizon_max_s, time),
        "cloud.freeze_after_s": (cloud.freeze_after_s, time),
        "guard.command_age_max_ms": (guard.command_age_max_ms, time * 1e3),
    }
    raised = [
        f"{key}={value:g}"
        for key, (now, value) in present.items()
        if value > now and key not in given
    ]
    return raised, needed


def describe(margin: Margin) -> dict[str, Any]:
    """Return the result as values for JSON."""
    asked = margin.asked
    document: dict[str, Any] = {
        "key": asked.key,
        "experiment": asked.experiment,
        "overrides": list(asked.settings),
        "seeds": asked.seeds,
        "resolution": margin.size,
        "smallest": margin.value(margin.bottom),
        "largest": margin.value(margin.top),
        "largest_why": margin.top_why,
    }
    for name, each in margin.found.items():
        document |= _entries(name, each, margin)
    if large := margin.large_step(document["stable_up_to"]):
        document["large_step"] = large
    return document


def _entries(name: str, found: ValueRange | None, margin: Margin) -> dict[str, Any]:
    """Return the part of the document about one question."""
    if found is None:
        return {f"{name}_up_to": None, f"{name}_trials": []}
    elsewhere = [[margin.value(a), margin.value(b)] for a, b in found.elsewhere]
    return {
        f"{name}_from": margin.value(found.first),
        f"{name}_up_to": margin.value(found.last),
        f"{name}_fails_below": margin.value(found.below),
        f"{name}_fails_at": margin.value(found.above),
        f"{name}_elsewhere": elsewhere,
        f"{name}_trials": margin.answers(name),
    }


# The result in words.


def as_text(document: Mapping[str, Any], margin: Margin) -> str:
    """Format the result of `describe`, and the ranges found for each question."""
    lines = [_in_words(name, each, margin) for name, each in margin.found.items()]
    if "large_step" in document:
        lines.insert(1, _large(document["large_step"]))
    return "\n".join(lines)


def _in_words(name: str, found: ValueRange | None, margin: Margin) -> str:
    """Return the answer to one question in one line."""
    if found is None:
        return f"{name}: not asked, because the step does not depend on this key"

    def failed(number: int) -> str:
        return f"{margin.name(number)}: {why(name, margin.answer(name, number))}"

    verb = {"stable": "is stable"}.get(name, name)
    if found.last is None:
        return f"no value {verb}; it fails at {failed(margin.bottom)}"
    start = f" from {margin.name(found.first or 0)}" if found.below is not None else ""
    text = f"{name}{start} up to {margin.name(found.last)}"
    if found.above is None:
        text += f", {margin.top_why}"
    for number in (found.above, found.below):
        if number is not None:
            text += f"; fails at {failed(number)}"
    for first, last in found.elsewhere:
        reach = margin.name(first) + (f" to {margin.name(last)}" if last > first else "")
        text += f"; beyond values that fail, {reach} {verb}, too"
    return text


def why(question: str, answer: Answer) -> str:
    """Return "yes", or in one line why the answer to the question is no with one value."""
    if answer[question]:
        return "yes"
    where = f", seed {answer['seed']}" if "seed" in answer else ""
    return f"{answer['code']}{where}: {answer['text'].partition(';')[0]}"


def _large(large: Answer) -> str:
    """Say whether a step of 1 m dies out at the largest stable value, and whether it saturates."""
    dies = "dies out, too" if large["stable"] else f"does not die out ({large['text']})"
    text = f"with this value a step of {large['size_m']:g} m per axis {dies}; the guard's speed cap"
    cap, share = f"of {large['speed_max_mps']:.3g} m/s", large.get("speed_limited", 0.0)
    return f"{text} {cap} shortens " + (f"{share:.1%} of the commands" if share else "no command")
