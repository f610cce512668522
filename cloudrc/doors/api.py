# SPDX-License-Identifier: Apache-2.0

"""The Python API: fly, sweep, compare, identify and verify from a program or a notebook.

    import cloudrc

    result = cloudrc.fly("steps", {"cloud.predictor": "last_sample"}, seed=3)
    result.numbers["prediction_error_rms"]  # [m]
    result["/odometry"]["position"]  # [m], numpy, shape (n, 3)

docs/python.md describes the API; other modules may change without notice.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.errors import CloudrcError, InterruptedRunError, NothingFlownError
from cloudrc.base.outside.refusal import check_names, naming
from cloudrc.base.outside.values import Quantity, to_plain
from cloudrc.base.requirements import MODES, require
from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.flight.experiment import advice_on, check_mode, load
from cloudrc.flight.folder import point_to, run_folder
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.results.metrics.flight import Columns, Flight
from cloudrc.results.metrics.response import Step, steps
from cloudrc.results.metrics.verdict import FlightFailure
from cloudrc.results.record.columns import Recording, Table

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release
    from cloudrc.results.report.document import Assessment


SECONDS = Quantity("s", 1.0, 3600.0)
"""Time to send probes, or to wait for a verdict."""
COUNT = Quantity(ge=1, whole=True)
"""Number of seeds or processes."""


@dataclass(frozen=True, eq=False)
class Result:
    """A flight with its verdict, its numbers and its recording.

    `result[topic][column]` is a numpy array; docs/topics.md lists all topics and columns.
    """

    verdict: str  # "success", "failure", or "interrupted" if nothing ended the mission
    failures: tuple[FlightFailure, ...]  # code, text, time [s], place [m]; see docs/verdict.md
    numbers: dict[str, float]  # metric -> value; a number that cannot be known is absent
    units: dict[str, str]  # metric -> SI unit; "1" for counts and shares
    notes: tuple[str, ...]  # sentences for the reader
    config: str  # the resolved experiment as YAML; `cloudrc run` repeats the flight from its file
    records_sha256: str  # hash of all records; equal experiments on one machine have equal hashes
    flight: Flight  # input of metrics: true states, control periods, applied commands

    def __getitem__(self, topic: str) -> Table:
        """Return the table of a topic; raise a KeyError that names all topics."""
        return self.recording[topic]

    @property
    def recording(self) -> Recording:
        """All tables; the stamps of their rows [ns] are on world's clock."""
        return self.flight.recording

    @property
    def applied(self) -> Columns:
        """Commands that world applied, one per row.

        A row also has the values with which cloud computed the command, such as the horizon.
        """
        return self.flight.applied

    @property
    def steps(self) -> tuple[Step, ...]:
        """Response to each step of the setpoint: overshoot, settling time and so on."""
        return steps(self.flight)

    def __repr__(self) -> str:
        """Return the verdict and the first failure in one line."""
        why = f", {self.failures[0].text}" if self.failures else ""
        return f"<Result: {self.verdict}{why}; {len(self.numbers)} numbers>"


@dataclass(frozen=True, eq=False)
class SweepTable:
    """The flights of a sweep, one per row, in the order of the grid.

    `table[column]` is a numpy array: an axis, `seed`, `verdict`, `failures` or a metric. A metric
    that a flight does not have is nan. An axis of numbers is float64, and None in it is nan; an
    axis of numbers and other values is text.
    """

    columns: dict[str, NDArray[Any]]  # name -> values, shape (n,)
    units: dict[str, str]  # metric -> SI unit; "1" for counts and shares
    folder: Path | None  # folder of the sweep; None if it was not kept

    def __getitem__(self, column: str) -> NDArray[Any]:
        """Return a column; raise a KeyError that names all columns."""
        if column not in self.columns:
            raise KeyError(f"no column {column!r}; columns: {', '.join(self.columns)}")
        return self.columns[column]

    def __len__(self) -> int:
        """Return the number of flights."""
        return len(self.columns["key"])


@dataclass(frozen=True, eq=False)
class Comparison:
    """The result of a comparison of A and B in pairs of flights."""

    name: str  # the first compared metric
    p: float  # p-value of its signed-rank test [1]; a value below 0.05 decides
    difference: float  # B - A [any unit: that of the metric]
    document: dict[str, Any]  # as `cloudrc compare -o json`: all metrics, success, the flights


def fly(
    experiment: str = "paper",
    settings: Mapping[str, Any] | None = None,
    *,
    seed: int | None = None,
    mode: Literal["virtual", "local", "cluster"] = "virtual",
    out: str | Path | None = None,
    context: str | None = None,
    namespace: str | None = None,
    release: str = "cloudrc",
    timeout: float = 300.0,
) -> Result:
    """Fly an experiment on this machine or in a Kubernetes cluster.

    Args:
        experiment: Name of a shipped experiment, or path of a YAML file.
        settings: Changes, as with `--set`: key -> value, such as `{"link.profile": "paper-p3"}`.
        seed: Random seed; with None, the seed in the experiment.
        mode: "virtual": in virtual time in this process; "local": in real time in five processes;
            "cluster": in the pods of a release.
        out: Folder for the recording and the report. With None, "virtual" writes no file, and the
            other modes make a new folder in runs/.
        context: For "cluster": context of the kubeconfig, by default the current one.
        namespace: For "cluster": namespace, by default that of the context.
        release: For "cluster": name of the Helm release, which is installed if it is missing.
        timeout: For "cluster": time limit for the pods to become ready [s].

    Settings that do not fit together cause a Python warning before the flight.

    Returns:
        The result, also if the mission failed.

    Raises:
        cloudrc.BadInputError: If a name, key or value is invalid, or if `out` is not empty.
        cloudrc.CloudrcError: If nothing has flown: docs/python.md lists the reasons.
    """
    check_names("mode", [mode], MODES)
    require(f"mode {mode}", MODES[mode])
    own = {} if seed is None else {"seed": seed}
    resolved = load(str(experiment), [*_texts(settings or {}), *_texts(own)])
    check_mode(resolved, mode)
    _warn(resolved)
    if mode == "virtual" and out is None:
        return _result(fly_in_memory(resolved))
    if mode != "cluster":
        return _fly_here(resolved, mode, out)
    from cloudrc.cluster.client import connect

    place = connect(context, namespace, release)
    return _fly_in(place, resolved, None if out is None else Path(out), timeout)


def _fly_here(experiment: ResolvedExperiment, mode: str, out: str | Path | None) -> Result:
    from cloudrc.flight.fly import fly

    folder = run_folder(experiment, mode, None if out is None else Path(out))
    return _read(experiment, folder, fly(experiment, mode, folder))


def _fly_in(
    place: Release, experiment: ResolvedExperiment, out: Path | None, timeout: float
) -> Result:
    from cloudrc.cluster.flight import check_can_begin, fly_in_cluster
    from cloudrc.cluster.own_files import check_experiment

    check_experiment(experiment)
    check_can_begin(place)
    folder = run_folder(experiment, "cluster", out)
    report = fly_in_cluster(experiment, folder, place, timeout)
    if out is None:
        point_to(folder, "latest")
    return _read(experiment, folder, report)


def _read(experiment: ResolvedExperiment, folder: Path, report: Mapping[str, Any]) -> Result:
    """Return the result of a flight whose recording and report are in a folder."""
    from cloudrc.results.report.folder import read_run
    from cloudrc.results.report.write import assess

    found = _result(assess(*read_run(folder), experiment.report.metrics))
    # A recording holds velocities in another frame: the last bit of a number may differ.
    numbers = {name: entry["value"] for name, entry in report["numbers"].items()}
    return replace(found, numbers=numbers, records_sha256=report.get("records_sha256", ""))


def _result(found: Assessment) -> Result:
    return Result(
        verdict=found.verdict.outcome,
        failures=found.verdict.failures,
        numbers={name: number.value for name, number in found.numbers.items()},
        units={name: number.unit for name, number in found.numbers.items()},
        notes=found.notes,
        config=dump(found.experiment),
        records_sha256=found.records_sha256 or "",
        flight=replace(found.flight, copies=True),
    )


def sweep(
    grid: str | Path | Mapping[str, Any], *, jobs: int = 1, out: str | Path | None = None
) -> SweepTable:
    """Fly a grid of settings with several seeds in virtual time; return a row per flight.

    Args:
        grid: Path of a sweep's file, or its content as a mapping, such as `{"experiment": "steps",
            "grid": {"link.profile": ["paper-p1", "paper-p3"]}, "seeds": 20}`.
        jobs: Number of processes.
        out: Folder of the sweep. If it holds flights of this sweep, only the missing ones are
            flown. With None, nothing is kept.

    Raises:
        cloudrc.BadInputError: If the grid or a point of it is invalid, or if the folder
            belongs to another sweep.
    """
    require("a sweep", ("world", "record"))
    from cloudrc.flight.trials.plan import read_plan
    from cloudrc.flight.trials.play import run
    from cloudrc.flight.trials.tables import NUMBERS
    from cloudrc.studies import sweep as work

    jobs = _count(jobs, "jobs")
    plan = read_plan(grid if isinstance(grid, Mapping) else Path(grid))
    _warn(*plan.points)
    with (
        TemporaryDirectory(prefix="cloudrc-sweep-") as temporary,
        work.open_folder(Path(out or temporary), "sweep") as folder,
    ):
        rows = work.begin(folder, plan)
        stopped = run(plan.flights.values(), rows, jobs, in_order=False)
        flown = work.finish(folder, plan)
    if stopped:
        raise _as_exception(stopped)
    columns = work.columns_of(flown, plan)
    numbers = {name for name in plan.axes if {*map(type, columns[name])} <= NUMBERS}
    arrays = {
        name: np.array(values, dtype=float if name in numbers or None in values else None)
        for name, values in columns.items()
    }
    units = {name: plan.units[name] for name in arrays if name in plan.units}
    return SweepTable(arrays, units, None if out is None else Path(out))


def compare(
    a: str | Mapping[str, Any],
    b: str | Mapping[str, Any],
    *,
    of: str = "steps",
    settings: Mapping[str, Any] | None = None,
    seeds: int = 10,
    numbers: Sequence[str] = (),
    jobs: int = 1,
    cost: bool = False,
) -> Comparison:
    """Fly an experiment with the settings A and with the settings B, with equal seeds, and compare.

    Args:
        a: KEY=VALUE[,KEY=VALUE...] as for `cloudrc compare`, or key -> value.
        b: The same for B.
        of: Name of a shipped experiment, or path of a YAML file.
        settings: Settings of both sides: key -> value.
        seeds: Fly the seeds 1 to `seeds`.
        numbers: Metrics to compare; by default those that matter first.
        jobs: Number of processes.
        cost: Whether to fly both also without a network, which gives the number J/J0; where the
            setpoint waits for the robot, off_ideal_path and T/T0.

    Raises:
        cloudrc.BadInputError: If a setting is invalid, or if no pair has a metric.
    """
    from cloudrc.studies import compare as pairs

    seeds, jobs = _count(seeds, "seeds"), _count(jobs, "jobs")
    first, second = (pairs.split_settings(x) if isinstance(x, str) else _texts(x) for x in (a, b))
    plan = pairs.plan_sides(of, _texts(settings or {}), first, second, seeds, numbers, cost=cost)
    _warn(*plan.points)
    flown, stopped = pairs.fly_pairs(plan, jobs)
    if stopped:
        raise _as_exception(stopped)
    document = pairs.compare(flown, plan.units, numbers)
    if not document["numbers"]:
        raise NothingFlownError("no pair has one of the numbers; name another with numbers=[...]")
    name, entry = next(iter(document["numbers"].items()))
    return Comparison(name, entry["p_wilcoxon"], entry["difference"], document)


def margin(
    key: str,
    *,
    of: str = "steps",
    settings: Mapping[str, Any] | None = None,
    seeds: int = 3,
    largest: float | None = None,
    resolution: float | None = None,
) -> dict[str, Any]:
    """Find up to which value of a key the loop is stable, and flights succeed.

    Args:
        key: Key of the experiment whose value is a number, such as `link.both.delay_ms`.
        of: Name of a shipped experiment, or path of a YAML file.
        settings: Changes of the experiment: key -> value.
        seeds: Fly the seeds 1 to `seeds`.
        largest: Largest value to try [any unit]; with None, 32 times the present one.
        resolution: Try multiples of this value [any unit].

    Returns:
        The result of `cloudrc margin -o json`: `stable_up_to`, `settles_up_to` and more.

    Raises:
        cloudrc.BadInputError: If the key has no range of numbers.
    """
    from cloudrc.studies.margin import Asked, Margin, describe

    for name, value in (("largest", largest), ("resolution", resolution)):
        if value is not None:
            with naming(name):
                Quantity(gt=0.0).of(value)
    seeds = _count(seeds, "seeds")
    work = Margin(Asked(key, of, _texts(settings or {}), seeds, largest, resolution))
    for question in work.questions:
        work.search(question)
    return describe(work)


def identify(run: str | Path) -> dict[str, Any]:
    """Fit the model of the velocity loop to a run, the folder or its MCAP file.

    The result is the content of a file that the predictor `command_history` reads: a value per axis
    of `time_constant` [s], `dead_time` [s] and `gain`, and their 95 % intervals.
    """
    require("identify", ("record",))
    from cloudrc.studies.identify import describe
    from cloudrc.studies.identify import identify as fit

    return describe(*fit(Path(run)))


def verify(
    target: str = "paper",
    settings: Mapping[str, Any] | None = None,
    *,
    shaper: Literal["relay", "netem"] = "relay",
    seconds: float | None = None,
    mode: Literal["local", "cluster"] = "local",
    context: str | None = None,
    namespace: str | None = None,
    release: str | None = None,
) -> dict[str, Any]:
    """Check by measurement that a link does what its profile says.

    Args:
        target: For "local": name or file of a link profile or an experiment.
        settings: For "local": changes of the experiment: key -> value.
        shaper: For "local": "relay", or "netem", which needs root.
        seconds: Time to send probes [s], by default as long as needed; for "cluster", the time to
            wait for a verdict [s].
        mode: "local" starts a link on this machine and sends probes over it; "cluster" asks for the
            verdict on the link of a release in flight.
        context: For "cluster": context of the kubeconfig; with None, the current one.
        namespace: For "cluster": namespace; with None, that of the context, or "default".
        release: For "cluster": name of the release; with None, the only one of the namespace.

    Returns:
        The result of `cloudrc link verify -o json`: `verdict` ("believed", "not believed" or
        "undecided"), `causes`, `notes` and, per direction, the measured quantities.

    Raises:
        cloudrc.BadInputError: If there is no such profile, or if a value is invalid.
        cloudrc.MissingPrerequisiteError: If root rights or a kubeconfig are missing.
        cloudrc.TimedOutError: If the link or the pods do not answer in time.
    """
    check_names("mode", [mode], ("local", "cluster"))
    if seconds is not None:
        with naming("seconds"):
            SECONDS.of(seconds)
    if mode == "local":
        from cloudrc.flight.links.verify import verify as measure

        return measure(target, _texts(settings or {}), shaper=shaper, seconds=seconds)
    require("mode cluster", ("kube",))
    from cloudrc.cluster import verify as of_release
    from cloudrc.cluster.releases import choose_release

    place = choose_release(context, namespace, release)
    with of_release.forwarded_pods(place) as pods:
        limit = seconds or of_release.RELEASE_TIMEOUT
        return of_release.verify_release(place.name, pods, limit)


def _warn(*experiments: ResolvedExperiment) -> None:
    for text in advice_on(*experiments):
        warnings.warn(text, stacklevel=4)


def _as_exception(stopped: CloudrcError) -> BaseException:
    """Return the exception for work that ended early."""
    return KeyboardInterrupt() if isinstance(stopped, InterruptedRunError) else stopped


def _count(value: Any, name: str) -> int:
    """Return the argument `name` as a number of seeds or processes; raise a BadInputError."""
    with naming(name):
        return COUNT.of(value)  # type: ignore[no-any-return]


def _texts(settings: Mapping[str, Any]) -> list[str]:
    """Return settings as texts KEY=VALUE."""
    found = list[str]()
    for key, value in settings.items():
        with naming(key):
            found.append(f"{key}={json.dumps(to_plain(value), ensure_ascii=False)}")
    return found
