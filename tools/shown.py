# SPDX-License-Identifier: Apache-2.0

"""The numbers that pages show, with the commands that give them.

`python -m tools.shown` types every command, says how long it took, and names what differs from the
page; `python -m tools.shown WORD` only those of pages whose name has this word. Every night a test
does the same with the commands that take less than 30 s. Numbers of real time, of a GPU or of other
packages stand on their page with machine, date and commit instead.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
NIGHTLY_MAX_S = 30.0
"""Longest command that is typed every night [s], on two cores."""
UNITS = {"": 1.0, "s": 1.0, "ms": 1e-3, "m": 1.0, "mm": 1e-3, "m s": 1.0, "%": 1e-2}
"""Unit on a page -> its size in the unit of the report."""


@dataclass(frozen=True)
class Shown:
    """What a page shows of a command.

    Attributes:
        page: The page, from the root of the repository.
        command: What its reader types, in a new folder.
        duration: How long that takes [s].
        lines: Lines of the page that are printed; blanks do not count.
        numbers: Number of the report of the last flight -> its value and unit on the page.
    """

    page: str
    command: str
    duration: float
    lines: tuple[str, ...] = ()
    numbers: Mapping[str, str] = field(default_factory=dict)

    def missing_on_page(self) -> list[str]:
        """Return the lines and values that the page does not have."""
        text = plain((ROOT / self.page).read_text("utf-8"))
        shown = (*self.lines, *self.numbers.values())
        return [each for each in shown if plain(each) not in text]

    def differences(self, folder: Path) -> Iterator[str]:
        """Type the command in a folder; yield each line and number that is another one now."""
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        environment = {**os.environ, "PATH": path, "COLUMNS": "200"}
        words = ["bash", "-c", self.command]
        done = subprocess.run(words, cwd=folder, env=environment, capture_output=True, text=True)
        printed = plain(done.stdout)
        for line in self.lines:
            if plain(line) not in printed:
                yield f"not printed: {line}\n{done.stdout}{done.stderr}"
        if self.numbers:
            report = json.loads((folder / "runs" / "latest" / "report.json").read_text("utf-8"))
            for name, shown in self.numbers.items():
                value = report["numbers"][name]["value"]
                if not agrees(value, shown):
                    yield f"{name} is {value:.6g}, the page has {shown}"


def plain(text: str) -> str:
    """Return a text with single blanks in place of all others."""
    return " ".join(text.split())


def agrees(value: float, shown: str) -> bool:
    """Tell whether a value is rounded to what a page shows, such as "98.5 ms"."""
    number, _, unit = shown.partition(" ")
    digits = len(number.partition(".")[2])
    return abs(value / UNITS[unit] - float(number)) <= 0.5001 * 10**-digits


FAST = "cloudrc run steps --mode virtual --report none"
SHOWN = (
    Shown(
        "docs/compare.md",
        "cloudrc compare cloud.predictor=constant_velocity cloud.predictor=constant_acceleration"
        " --of steps --set link.profile=paper-p3 --seeds 10",
        25.0,
        (
            "B has a lower prediction_error_rms: by 1.752 mm (1.412 .. 2.068), p = 0.002,"
            " in 10 of 10 pairs.",
        ),
    ),
    Shown(
        "docs/margin.md",
        "cloudrc margin link.both.delay_ms --of steps",
        60.0,
        (
            "stable up to 330 ms (RTT 660 ms); fails at 340 ms (RTT 680 ms): unstable, seed 1:"
            " a step of 0.1 m in z does not die out",
            "with this value a step of 1 m per axis dies out, too; the guard's speed cap of"
            " 4.64 m/s shortens no command",
            "settles up to 290 ms (RTT 580 ms); fails at 300 ms (RTT 600 ms): not_settled, seed 3:"
            " 2 of 10 steps did not settle",
        ),
    ),
    Shown(
        "docs/which-number.md",
        "cloudrc run paper --mode virtual --set link.profile=paper-p3",
        5.0,
        numbers={
            "rtt_mean": "98.5 ms",
            "loop_delay_mean": "107.8 ms",
            "delay_sample_mean": "114.1 ms",
            "age_of_information_mean": "62.5 ms",
            "age_at_actuator_mean": "126.1 ms",
            "age_at_actuator_p99": "179.4 ms",
        },
    ),
    Shown(
        "docs/which-number.md",
        "cloudrc run follow --mode virtual --set link.both.delay_ms=70",
        15.0,
        numbers={
            "frame_age_mean": "103 ms",
            "frame_age_p99": "136 ms",
            "seen_to_acted": "143 ms",
            "age_at_actuator_mean": "145 ms",
        },
    ),
    Shown(
        "docs/timeline.md",
        "cloudrc run paper --mode virtual --set link.profile=lte --set cloud.compute_ms=7 &&"
        " cloudrc timeline runs/latest",
        10.0,
        (
            "uplink mean 28.80 p99 47.69 ms",
            "telemetry waits for cloud's period mean 7.05 p99 39.03 ms",
            "cloud computes mean 7.00 p99 7.00 ms",
            "downlink mean 19.60 p99 34.02 ms",
            "age when it begins to act mean 63.42 p99 107.78 ms time average of the age 69.54 ms",
            "of 2912 commands that the robot followed; the others: 9 lost, 167 superseded",
        ),
    ),
    Shown(
        "docs/timeline.md",
        "cloudrc run gap --mode virtual --set link.profile=lte --set cloud.perception_ms=60 &&"
        " cloudrc timeline runs/latest",
        10.0,
        (
            "uplink of the scan or picture mean 33.16 p99 81.40 ms",
            "perception computes mean 60.00 p99 60.00 ms",
            "age of a scan or picture when acted on mean 120.95 p99 177.68 ms",
        ),
    ),
    Shown(
        "docs/definitions.md",
        "cloudrc run paper-verbatim --mode virtual --report none --set link.profile=paper-p3",
        5.0,
        numbers={"delay_sample_mean": ".150 s", "loop_delay_mean": ".142 s"},
    ),
    Shown(
        "docs/fleet.md",
        "cloudrc run steps --set fleet.robots=6 --set cell.rate_kbit=1000"
        " --set cell.queue_packets=10",
        27.0,
        (
            "median 144 198 0.00 0.624 0.01% 0.00% 2 -",
            "worst 151 209 0.00 0.748 36.16% 0.00% 1560 -",
            "2 151 209 0.00 0.748 36.16% 0.00% 1560 failure not_settled",
            "uplink 1.11 100% 15.08 - - 16.69 9 2643",
            "downlink 0.56 56% 0.14 0.32 0.58 2.12 3 0",
        ),
    ),
    Shown(
        "docs/capacity.md",
        "cloudrc capacity steps --cell 1000 --queue fifo,newest --seeds 10",
        300.0,
        (
            "capacity, fifo 50, pid: 5 robots [5, 5] (95 % interval over 10 seeds)",
            "capacity, newest, pid: 15 robots [14, 15] (95 % interval over 10 seeds)",
        ),
    ),
    Shown(
        "docs/place.md",
        "cloudrc place fast --set cloud.controller=mpc --compute 0,20,60",
        120.0,
        (
            "0 ms, 1 robot: onboard or edge: cross-track error 15 mm, not 18 mm (cloud)",
            "20 ms, 1 robot: edge: cross-track error 17 mm, not 25 mm (onboard), 19 mm (cloud)",
            "60 ms, 1 robot: edge or cloud: cross-track error 21 mm, not 46 mm (onboard)",
        ),
    ),
    Shown(
        "docs/place.md",
        "cloudrc place steps --calm --compute 60 --robots 1,4",
        60.0,
        (
            "60 ms, 1 robot: edge or cloud: 6/6 succeed, not 0/6 (onboard)",
            "60 ms, 4 robots: cloud: 23/24 succeed, not 0/24 (onboard), 0/24 (edge)",
        ),
    ),
    # The unfinished files of the exercise, then cloudrc's parts in their place.
    *(
        Shown(
            "docs/exercise.md",
            f"cloudrc class new exercise; {FAST} --set cloud.{part}=./exercise/{file}.py",
            5.0,
            numbers=number,
        )
        for part, file, number in (
            ("estimator", "delay_estimator", {"delay_estimate_error_rms": "117 ms"}),
            ("predictor", "predictor", {"prediction_error_rms": "56 mm"}),
            ("controller", "controller", {"iae_mean": "5.7 m s"}),
        )
    ),
    Shown(
        "docs/exercise.md",
        FAST,
        5.0,
        numbers={
            "delay_estimate_error_rms": "21 ms",
            "prediction_error_rms": "12 mm",
            "iae_mean": "1.7 m s",
        },
    ),
    Shown(
        "docs/exercise.md",
        "cloudrc run paper --mode virtual --report none --set link.profile=satellite",
        5.0,
        numbers={"duration": "37 s"},
    ),
)


def main(word: str = "") -> int:
    """Type the commands of all pages, or of those whose name has a word."""
    failed = 0
    for each in SHOWN:
        if word not in each.page:
            continue
        began = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            found = [*each.missing_on_page(), *each.differences(Path(folder))]
        failed += bool(found)
        took = time.monotonic() - began
        print(f"{'differs' if found else 'ok':8}{took:4.0f} s  {each.page}: {each.command}")
        print("".join(f"  {text}\n" for text in found), end="")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
