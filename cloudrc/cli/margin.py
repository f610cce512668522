"""`cloudrc margin KEY`: find the largest value of KEY at which all flights succeed."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from contextlib import closing
from typing import TYPE_CHECKING, Any, TypeAlias

from cloudrc.advice import simulate_ages
from cloudrc.cli.compare import flight_arguments
from cloudrc.cli.extras import MODES, require
from cloudrc.cli.interrupts import interrupt_on_signals
from cloudrc.cli.output import output_argument, print_or_drop, print_result
from cloudrc.cli.pool import map_in_order
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment

EPILOG = """\
examples:
  cloudrc margin link.both.delay_ms
  cloudrc margin link.both.delay_ms --set cloud.predictor=last_sample --seeds 6
  cloudrc margin link.uplink.loss --resolution 0.05 -o json

A value is stable if the flights of all seeds succeed. With a key of the link,
the command also raises cloud.horizon_max_s, cloud.freeze_after_s and
guard.command_age_max_ms as the delays need it, unless --set gives them."""
SLACK = 0.1
"""Reserve between the largest age of `simulate_ages` and the limits of cloud and guard [s]."""
STEPS_MAX = 100
"""Default of --max, as a multiple of the first value."""


Trial: TypeAlias = dict[str, Any]
"""Result of the flights with one value: `value`, `stable`, the guard's `speed_max_mps`; for a delay
`rtt_ms`; after a failure `code` ("refused": invalid value), `text` and `seed`."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add = parser.add_argument
    add("key", metavar="KEY", help="key of the experiment whose value is a number")
    flight_arguments(parser, seeds=3)
    about = "largest value to try (default: 100 times the first, which is the present one)"
    add("--max", type=float, metavar="X", help=about)
    about = "try multiples of R (default: 10 for a key in ms, else 0.01)"
    add("--resolution", type=float, metavar="R", help=about)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Print the largest value of KEY at which all flights succeed; return 0, or 1 if none."""
    from cloudrc.cli.run import load, refuse_seed

    interrupt_on_signals()
    require("margin", MODES["virtual"])
    key, size, limit = options.key, options.resolution, options.max
    refuse_seed([*options.set, f"{key}=0"])
    if size is None:
        size = 10.0 if key.endswith("_ms") else 0.01
    present = _present(load(options.experiment, options.set), key)
    first = max(1, round(present / size)) if 0 < size < math.inf else 1
    limit = STEPS_MAX * first * size if limit is None else limit
    if not 0 < size <= limit < math.inf:
        raise BadInputError(f"--resolution {size:g} must be above 0, --max {limit:g} not below it")
    top = math.floor(limit / size + 1e-9)
    tried: dict[int, Trial] = {}

    def works(step: int) -> bool:
        if step not in tried:
            tried[step] = _try(options, round(step * size, 9), first=not tried)
            if options.output == "table":
                print_or_drop(f"{_value(key, tried[step]):<26}{_result(tried[step])}")
        return bool(tried[step]["stable"])

    low, high = largest_stable(works, min(first, top), top)
    # The search assumes that all smaller values are stable: check two of them.
    odd = [step for step in (low - 1, low * 3 // 4) if step > 0 and not works(step)]
    document = {
        **{"key": key, "experiment": options.experiment},
        **{"overrides": options.set, "seeds": options.seeds, "resolution": size},
        "stable_up_to": tried[low]["value"] if low else None,
        "fails_at": tried[high]["value"] if high else None,
        "fails_below": [tried[step]["value"] for step in odd],
        "trials": [tried[step] for step in sorted(tried)],
    }
    answer = f"stable up to {_value(key, tried[low])}" if low else "no value is stable"
    if not high:
        answer += ", the largest value tried; raise --max"
    for step in [*([high] if high else []), *odd]:
        answer += f"; fails at {_value(key, tried[step])}: {_result(tried[step])}"
    print_result(options.output, document, f"\n{answer}")
    return 0 if low else 1


def largest_stable(works: Callable[[int], bool], start: int, top: int) -> tuple[int, int]:
    """Find the largest n from 1 to `top` for which `works(n)` is true: double `start`, then bisect.

    Return n and n + 1. The first is 0 if no number works; the second is 0 if `top` works.
    """
    low, high = 0, start
    while works(high):
        if high == top:
            return top, 0
        low, high = high, min(2 * high, top)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if works(middle) else (low, middle)
    return low, high


def _present(experiment: ResolvedExperiment, key: str) -> float:
    """Return the present value of a key; 0 if the value is null or the key is unknown."""
    from cloudrc.config.document import child

    value: Any = experiment.model_dump(mode="json")
    for name in key.replace("link.both.", "link.uplink.").split("."):
        value = child(value, name)
    if isinstance(value, str | bool | dict | list):
        raise BadInputError(f"{key}: is no number; name a key such as link.both.delay_ms")
    return float(value or 0.0)


def _try(options: argparse.Namespace, value: float, *, first: bool) -> Trial:
    """Fly one seed after the other with the key set to `value`, until a flight fails.

    An invalid `value` gives a trial that is not stable. If `value` is the `first` one of the
    search, raise a BadInputError instead, because then the key is wrong.
    """
    from cloudrc.cli.run import load
    from cloudrc.sweep.flight import fly_point

    settings = [*options.set, f"{options.key}={value:.12g}"]
    try:
        experiment = load(options.experiment, settings)
    except BadInputError as error:
        if first:  # the key is wrong, not its size
            raise
        return {"value": value, "stable": False, "code": "refused", "text": str(error)}
    trial: Trial = {"value": value, "stable": True}
    if options.key.startswith("link."):
        given = {text.partition("=")[0].strip() for text in options.set}
        settings += [text for text in _limits(experiment) if text.partition("=")[0] not in given]
        experiment = load(options.experiment, settings)
        if options.key.endswith("delay_ms"):
            trial["rtt_ms"] = experiment.uplink.delay_ms + experiment.downlink.delay_ms
    trial["speed_max_mps"] = experiment.guard.speed_max_mps
    jobs = [experiment.model_copy(update={"seed": n + 1}) for n in range(options.seeds)]
    # A worker takes as long to start as three flights of `steps`.
    with closing(map_in_order(fly_point, jobs, len(jobs) // 4)) as flights:
        for seed, flight in enumerate(flights, start=1):
            if flight["verdict"] != "success":
                code = (*flight["failures"], flight["verdict"])[0]
                failed = {"stable": False, "code": code, "text": flight["text"], "seed": seed}
                return trial | failed
    return trial


def _limits(experiment: ResolvedExperiment) -> list[str]:
    """Return time limits of cloud and guard, as KEY=VALUE, that are long enough for the link."""
    from cloudrc.config.load import COMMAND_AGE_MAX_MS, FREEZE_AFTER_S, HORIZON_MAX_S
    from cloudrc.config.schema import COMMAND_AGE_MS

    ages, echoes = simulate_ages(experiment)
    needed = math.ceil((max([*ages, *echoes], default=0.0) + SLACK) * 10) / 10
    needed = min(needed, COMMAND_AGE_MS[1] * 1e-3)
    return [
        f"cloud.horizon_max_s={max(needed, HORIZON_MAX_S):g}",
        f"cloud.freeze_after_s={max(needed, FREEZE_AFTER_S):g}",
        f"guard.command_age_max_ms={max(needed * 1e3, COMMAND_AGE_MAX_MS):g}",
    ]


def _value(key: str, trial: Trial) -> str:
    rtt = f" (RTT {trial['rtt_ms']:g} ms)" if "rtt_ms" in trial else ""
    return f"{trial['value']:.12g}{' ms' if key.endswith('_ms') else ''}{rtt}"


def _result(trial: Trial) -> str:
    if trial["stable"]:
        return "stable"
    where = f", seed {trial['seed']}" if "seed" in trial else ""
    return f"{trial['code']}{where}: {trial['text'].partition(';')[0]}"
