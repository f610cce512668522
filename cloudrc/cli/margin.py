"""`cloudrc margin KEY`: find the largest value of a key with which every flight succeeds."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from cloudrc.cli.advice import simulate_ages
from cloudrc.cli.compare import fly_job
from cloudrc.cli.extras import MODES, require
from cloudrc.cli.output import format_document, output_argument, print_or_drop
from cloudrc.cli.parser import read_count
from cloudrc.cli.pool import interrupt_on_signals, map_in_order
from cloudrc.config.document import child
from cloudrc.config.load import COMMAND_AGE_MAX_MS, FREEZE_AFTER_S, HORIZON_MAX_S
from cloudrc.config.schema import COMMAND_AGE_MS
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment

EPILOG = """\
examples:
  cloudrc margin link.both.delay_ms --of steps
  cloudrc margin link.both.delay_ms --set cloud.predictor=constant_acceleration
  cloudrc margin link.uplink.loss --resolution 0.05 -o json

A value is stable if the flights of all seeds succeed. A key of the link also
sets cloud.horizon_max_s, cloud.freeze_after_s and guard.command_age_max_ms to
what the delays need, unless --set does. The speed cap of the guard falls with
the last of them."""
SLACK = 0.1
"""Distance of the limits of cloud and guard from the largest age in the simulated link [s]."""
STEPS_MAX = 100
"""Default of --max, as a multiple of the first value [1]."""
REFUSED = "refused"
"""`Trial.code` if the schema does not allow the value."""
UNITS = {"_ms": " ms", "_s": " s", "_kbit": " kbit/s", "_m": " m", "_mps": " m/s"}
"""End of a key -> unit."""


@dataclass(frozen=True, slots=True)
class Trial:
    """The flights with one value."""

    value: float  # in the unit of the key
    stable: bool
    code: str = ""  # of the first flight that failed, or REFUSED
    text: str = ""  # the same in words
    seed: int | None = None  # of this flight
    rtt_ms: float | None = None  # sum of the mean one-way delays, for a delay of the link
    speed_max_mps: float | None = None  # the guard's speed cap


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("key", metavar="KEY", help="key of the experiment whose value is a number")
    about = "experiment to fly: a shipped name or a YAML file (default: steps)"
    add("--of", default="steps", dest="experiment", metavar="EXPERIMENT", help=about)
    about = "change one key of the experiment; repeatable"
    add("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    add("--seeds", type=read_count, default=3, metavar="N", help="fly seeds 1 to N (default: 3)")
    about = "largest value to try (default: 100 times the first one)"
    add("--max", type=_positive, metavar="X", help=about)
    about = "try multiples of R (default: 10 for a key in ms, else 0.01)"
    add("--resolution", type=_positive, metavar="R", help=about)
    output_argument(parser)


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0):
        raise argparse.ArgumentTypeError(f"'{text}' is not a number above 0")
    return value


def execute(options: argparse.Namespace) -> int:
    """Search and print; return 0, or 1 if no value is stable."""
    from cloudrc.cli.run import load
    from cloudrc.sweep.margin import largest_stable

    interrupt_on_signals()
    require("margin", MODES["virtual"])
    key, size = options.key, options.resolution or _default_resolution(options.key)
    first = max(1, round(_present(load(options.experiment, options.set), key) / size))
    top = math.floor(options.max / size + 1e-9) if options.max else STEPS_MAX * first
    if top < 1:
        raise BadInputError(f"--max {options.max:g}: is below --resolution {size:g}; raise it")
    tried: dict[int, Trial] = {}

    def works(step: int) -> bool:
        if step not in tried:
            value = round(step * size, 9)
            try:
                trial = _try(options, value)
            except BadInputError as error:
                if not tried:  # the key, not its size, is wrong
                    raise
                trial = Trial(value, False, REFUSED, str(error))
            tried[step] = trial
            if options.output == "table":
                print_or_drop(
                    f"{_value(key, trial):<28}{'stable' if trial.stable else _why(trial)}"
                )
        return tried[step].stable

    low, high = largest_stable(works, min(first, top), top)
    # The search assumes that all smaller values are stable: check two of them.
    odd = [tried[step] for step in (low - 1, low * 3 // 4) if step > 0 and not works(step)]
    last, unstable = tried.get(low), None if high is None else tried[high]
    document = {
        **{"schemaVersion": 1, "key": key, "experiment": options.experiment},
        **{"overrides": options.set, "seeds": options.seeds, "resolution": size},
        "stable_up_to": last and last.value,
        "unstable_at": unstable and unstable.value,
        "unstable_below": [trial.value for trial in odd],
        "trials": [asdict(tried[step]) for step in sorted(tried)],
    }
    shown = f"\n{_answer(key, last, unstable, odd)}"
    print_or_drop(shown if options.output == "table" else format_document(document, options.output))
    return 0 if last else 1


def _default_resolution(key: str) -> float:
    return 10.0 if key.endswith("_ms") else 0.01


def _present(experiment: ResolvedExperiment, key: str) -> float:
    """Return the present value of a key; 0 if it is null or unknown, which the search refuses."""
    value: Any = experiment.model_dump(mode="json")
    for name in key.replace("link.both.", "link.uplink.").split("."):
        value = child(value, name)
    if isinstance(value, str | bool | dict | list):
        raise BadInputError(f"{key}: is no number; name a key such as link.both.delay_ms")
    return float(value or 0.0)


def _try(options: argparse.Namespace, value: float) -> Trial:
    """Fly all seeds with one value of the key until one fails."""
    from cloudrc.cli.run import load

    settings, rtt_ms = [*options.set, f"{options.key}={value:g}"], None
    experiment = load(options.experiment, settings)
    if options.key.startswith("link."):
        if options.key.endswith("delay_ms"):
            rtt_ms = experiment.uplink.delay_ms + experiment.downlink.delay_ms
        limits = _limits(experiment)
        if not limits:
            text = f"the link needs a guard.command_age_max_ms above {COMMAND_AGE_MS[1]}, its limit"
            return Trial(value, False, REFUSED, text, rtt_ms=rtt_ms)
        given = {text.partition("=")[0].strip() for text in options.set}
        settings += [f"{name}={limit:g}" for name, limit in limits.items() if name not in given]
        experiment = load(options.experiment, settings)
    trial = Trial(value, True, rtt_ms=rtt_ms, speed_max_mps=experiment.guard.speed_max_mps)
    jobs = [(options.experiment, settings, seed + 1) for seed in range(options.seeds)]
    # A worker takes as long to start as three flights of `steps`.
    with closing(map_in_order(fly_job, jobs, len(jobs) // 4)) as flights:
        for seed, flight in enumerate(flights, start=1):
            if flight.verdict != "success":
                code = (*flight.failures, flight.verdict)[0]
                return replace(trial, stable=False, code=code, text=flight.text, seed=seed)
    return trial


def _limits(experiment: ResolvedExperiment) -> dict[str, float]:
    """Return limits of cloud and guard that the link does not reach; {} if the schema has none."""
    ages, echoes = simulate_ages(experiment)
    needed = math.ceil((max([*ages, *echoes], default=0.0) + SLACK) * 10) / 10
    if needed * 1e3 > COMMAND_AGE_MS[1]:
        return {}
    return {
        "cloud.horizon_max_s": max(needed, HORIZON_MAX_S),
        "cloud.freeze_after_s": max(needed, FREEZE_AFTER_S),
        "guard.command_age_max_ms": max(needed * 1e3, COMMAND_AGE_MAX_MS),
    }


def _value(key: str, trial: Trial) -> str:
    unit = next((text for end, text in UNITS.items() if key.endswith(end)), "")
    rtt = "" if trial.rtt_ms is None else f" (RTT {trial.rtt_ms:g} ms)"
    return f"{trial.value:g}{unit}{rtt}"


def _why(trial: Trial) -> str:
    where = "" if trial.seed is None else f", seed {trial.seed}"
    return f"{trial.code}{where}: {trial.text.partition(';')[0]}"


def _answer(key: str, last: Trial | None, unstable: Trial | None, odd: Sequence[Trial]) -> str:
    """Say in one or two sentences up to which value the flights are stable."""
    if last is None:
        assert unstable is not None
        text = f"no stable value: {_value(key, unstable)} fails, {_why(unstable)}"
        return f"{text}; lower --resolution, or change the experiment"
    text = f"stable up to {_value(key, last)}"
    if unstable is None:
        text += ", the largest value tried; raise --max"
    else:
        text += f"; fails at {_value(key, unstable)}: {_why(unstable)}"
    for trial in odd:
        text += f"\nbut {_value(key, trial)} fails, too: values below are not all stable"
    if key.startswith("link.") and last.speed_max_mps:
        text += f"\nthe guard caps the speed at {last.speed_max_mps:.3g} m/s there"
    return text
