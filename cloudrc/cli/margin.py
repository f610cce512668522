"""`cloudrc margin KEY`: up to which value of KEY is the loop stable, and do flights succeed?"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable, Iterable
from contextlib import closing
from typing import TYPE_CHECKING, Any, TypeAlias

from cloudrc.cli.compare import flight_arguments
from cloudrc.cli.extras import MODES, require
from cloudrc.cli.output import escape, output_argument, print_or_drop, print_result
from cloudrc.errors import BadInputError
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.workers import map_in_order

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.runs.margin import ValueRange

EPILOG = """\
examples:
  cloudrc margin link.both.delay_ms
  cloudrc margin link.both.delay_ms --set cloud.predictor=last_sample --seeds 6
  cloudrc margin guard.command_age_max_ms --max 500
  cloudrc margin link.uplink.loss --resolution 0.05 -o json

Two answers. The loop is stable if the response to a step of 0.1 m per axis dies
out, in the scene 'empty'. It settles in time if the flights of the experiment
succeed with all seeds. The search begins at the present value and goes up and
down. It raises cloud.horizon_max_s, cloud.freeze_after_s and
guard.command_age_max_ms as the delays need it, unless --set gives them."""
QUESTIONS = {
    "stable": "is the loop stable? a step of {small:g} m per axis in the scene {scene}",
    "settles": "does it settle in time? flights of {experiment}",
}
"""Name of a question -> the question in words."""
NOT_IN_STEP = "mission.", "criteria.", "report."
"""Keys that begin so do not change the step, so that stability does not depend on them."""

Trial: TypeAlias = dict[str, Any]
"""Result of the flights with one value: `value`, the guard's `speed_max_mps`, and the answer as
`stable` or `settles`; for a delay `rtt_ms`; after a failure `code`, `text` and `seed`."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("key", metavar="KEY", help="key of the experiment whose value is a number")
    flight_arguments(parser, seeds=3)
    about = "largest value to try (default: 32 times the first, which is the present one)"
    add("--max", type=float, metavar="X", help=about)
    about = "try multiples of R (default: 10 for a key in ms, 1 for whole numbers, else 0.01)"
    add("--resolution", type=float, metavar="R", help=about)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Print both answers; return 0, or 1 if no value is stable (or, without that, none settles)."""
    interrupt_on_signals()
    require("margin", MODES["virtual"])
    trials = Trials(options)
    asked = [name for name in QUESTIONS if name == "settles" or trials.step_depends]
    document: dict[str, Any] = {
        **{"key": options.key, "experiment": options.experiment},
        **{"overrides": options.set, "seeds": options.seeds, "resolution": trials.size},
        **{"smallest": trials.value(trials.bottom), "largest": trials.value(trials.top)},
        "largest_why": trials.top_why,
    }
    lines = []
    for name in QUESTIONS:
        found = trials.search(name) if name in asked else None
        document |= _entries(name, found, trials)
        lines.append(_answer(name, found, trials))
    if large := trials.large_step(document["stable_up_to"]):
        document["large_step"] = large
        lines.insert(1, _large(large))
    print_result(options.output, document, "\n" + "\n".join(map(escape, lines)))
    return 0 if document[f"{asked[0]}_up_to"] is not None else 1


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

    def __init__(self, options: argparse.Namespace) -> None:
        """Read the present value and the range of the search; refuse a key that has no range."""
        from cloudrc.runs.experiment import load, refuse_seed
        from cloudrc.runs.margin import STEPS_MAX, check_largest, present_value

        self._options, self._load = options, load
        key = options.key
        refuse_seed([*options.set, f"{key}=0"])
        self.step_depends = not key.startswith(NOT_IN_STEP)
        now = present_value(load(options.experiment, options.set), key)
        if options.max is not None:
            check_largest(key, options.max)
        elif now is None:
            load(options.experiment, [*options.set, f"{key}=1"])  # names an unknown key
            raise BadInputError(f"{key}: has no value now; name the largest one to try with --max")
        self.size = 1.0 if isinstance(now, int) else 0.01
        if key.endswith("_ms"):
            self.size = 10.0
        if options.resolution is not None:
            self.size = options.resolution
        # Without a value the key has no effect, as a large value has: begin there.
        self.present = self._number(options.max if now is None else now)
        given = STEPS_MAX * self.present * self.size if options.max is None else options.max
        if not 0 < self.size <= given < math.inf:
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
        from cloudrc.runs.margin import bisect

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
        from cloudrc.runs.margin import LIMIT_MAX, limits

        options = self._options
        settings = [*options.set, f"{options.key}={self.value(number):.12g}"]
        try:
            experiment = self._load(options.experiment, settings)
        except BadInputError as error:
            return None, str(error)
        given = [text.partition("=")[0].strip() for text in settings]
        if options.key == "guard.speed_max_mps":  # a longer limit would lower the largest speed
            given.append("guard.command_age_max_ms")
        more, needed = limits(experiment, given)
        if needed > LIMIT_MAX and "guard.command_age_max_ms" not in given:
            age = f"a command would be {needed:g} s old"
            age = age if needed < math.inf else "no command arrives within 20 s"
            return None, f"{age}, and guard.command_age_max_ms ends at {LIMIT_MAX:g} s"
        return (self._load(options.experiment, [*settings, *more]) if more else experiment), ""

    def search(self, question: str) -> ValueRange:
        """Find the range of values in which the answer to a question is yes."""
        from cloudrc.runs.margin import search
        from cloudrc.runs.stability import SCENE, SMALL

        options = self._options
        stream = sys.stdout if options.output == "table" else sys.stderr
        facts = {"small": SMALL, "scene": SCENE, "experiment": options.experiment}
        text = QUESTIONS[question].format(**facts)
        print_or_drop(escape(f"{text}, seeds 1 to {options.seeds}"), stream)

        def works(number: int) -> bool:
            trial = self._try(question, number)
            line = f"  {self.name(number):<26}{_result(question, trial)}"
            print_or_drop(escape(line), stream)
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
                if self._options.key.endswith("delay_ms"):
                    trial["rtt_ms"] = experiment.uplink.delay_ms + experiment.downlink.delay_ms
                trial["speed_max_mps"] = experiment.guard.speed_max_mps
                ask = _ask_stable if question == "stable" else _ask_settles
                trial |= self._fly(experiment, ask, question)
            self._done[question, number] = trial
        return self._done[question, number]

    def _fly(
        self, experiment: ResolvedExperiment, ask: Callable[..., Iterable[Trial]], question: str
    ) -> Trial:
        """Fly one seed after the other, until an answer is no; return what is new in the trial."""
        seeds = range(1, self._options.seeds + 1)
        jobs = [experiment.model_copy(update={"seed": seed}) for seed in seeds]
        result: Trial = {}
        for seed, answer in zip(seeds, ask(jobs), strict=False):
            result = answer
            if not answer[question]:
                return result | {"seed": seed}
        return result

    def large_step(self, value: float | None) -> Trial:
        """Fly a step of 1 m per axis at the stable `value` [any unit]; {} if it is None."""
        from cloudrc.runs.stability import LARGE, fly_step

        experiment = None if value is None else self.experiment(self._number(value))[0]
        if experiment is None:
            return {}
        found = fly_step(experiment.model_copy(update={"seed": 1}), LARGE)
        return {"size_m": LARGE, "speed_max_mps": experiment.guard.speed_max_mps, **found}

    def name(self, number: int) -> str:
        """Return the value of a number with its unit and, for a delay, the round trip."""
        experiment, _ = self.experiment(number)
        key, rtt = self._options.key, ""
        if key.endswith("delay_ms") and experiment is not None:
            rtt = f" (RTT {experiment.uplink.delay_ms + experiment.downlink.delay_ms:g} ms)"
        return f"{self.value(number):.12g}{' ms' if key.endswith('_ms') else ''}{rtt}"


def _ask_stable(jobs: list[ResolvedExperiment]) -> Iterable[Trial]:
    from cloudrc.runs.stability import fly_step

    # A worker takes as long to start as some flights.
    with closing(map_in_order(fly_step, jobs, len(jobs) // 4)) as answers:
        yield from answers


def _ask_settles(jobs: list[ResolvedExperiment]) -> Iterable[Trial]:
    from cloudrc.runs.flight import fly_point

    with closing(map_in_order(fly_point, jobs, len(jobs) // 4)) as flights:
        for flight in flights:
            if flight["verdict"] == "success":
                yield {"settles": True}
            else:
                code = (*flight["failures"], flight["verdict"])[0]
                yield {"settles": False, "code": code, "text": flight["text"]}


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


def _answer(name: str, found: ValueRange | None, trials: Trials) -> str:
    """Return the answer to one question in one line."""
    if found is None:
        return f"{name}: not asked, because the step does not depend on this key"
    if found.first is None or found.last is None:
        first = trials.bottom
        failed = _result(name, trials.trial(name, first))
        return f"no value {_verb(name)}; {trials.name(first)} fails: {failed}"
    start = f" from {trials.name(found.first)}" if found.below is not None else ""
    text = f"{name}{start} up to {trials.name(found.last)}"
    if found.above is None:
        text += f", {trials.top_why}"
    for number in (found.above, found.below):
        if number is not None:
            failed = _result(name, trials.trial(name, number))
            text += f"; fails at {trials.name(number)}: {failed}"
    for first, last in found.elsewhere:
        reach = trials.name(first) + (f" to {trials.name(last)}" if last > first else "")
        text += f"; beyond values that fail, {reach} {_verb(name)}, too"
    return text


def _verb(name: str) -> str:
    return "is stable" if name == "stable" else "settles"


def _result(question: str, trial: Trial) -> str:
    if trial[question]:
        return "yes"
    where = f", seed {trial['seed']}" if "seed" in trial else ""
    return f"{trial['code']}{where}: {trial['text'].partition(';')[0]}"


def _large(large: Trial) -> str:
    """Say whether a step of 1 m dies out at the largest stable value, and whether it saturates."""
    dies = "dies out, too" if large["stable"] else f"does not die out ({large['text']})"
    text = f"with this value a step of {large['size_m']:g} m per axis {dies}; the guard's speed cap"
    cap, share = f"of {large['speed_max_mps']:.3g} m/s", large.get("speed_limited", 0.0)
    return f"{text} {cap} shortens " + (f"{share:.1%} of the commands" if share else "no command")
