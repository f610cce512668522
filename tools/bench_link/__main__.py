"""`make bench-link`: measure the relay, print asked beside measured, and the anchors beside both.

Close other programs first: the tails of every row are the machine's, too, which is why the anchors
run in turns with the relay. Exit codes: 0 all held, 1 something did not, 3 no C compiler.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from cloudrc.cli.output import table
from cloudrc.errors import CloudrcError
from tools.bench_link import stages
from tools.bench_link.relays import compile_anchors, fifo_allowed

STAGES = ("release", "throughput", "profiles", "overload", "bursts")


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="make bench-link", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the time; for a look")
    parser.add_argument("--only", action="append", choices=STAGES, help="this stage; repeatable")
    parser.add_argument("-o", "--output", choices=("table", "json"), default="table")
    options = parser.parse_args()
    lines: list[stages.Line] = []
    details: list[dict[str, object]] = []
    quick, fifo = options.quick, fifo_allowed()
    try:
        with TemporaryDirectory(prefix="bench-link-") as name:
            folder, programs = Path(name), compile_anchors(Path(name))
            for stage in options.only or STAGES:
                print(f"bench-link: {stage} ...", file=sys.stderr, flush=True)
                if stage == "release":
                    rounds = (2, 3.0) if quick else (5, 20.0)  # 100,000 of each in all
                    lines += stages.releases(folder, programs, *rounds, fifo=fifo)
                elif stage == "throughput":
                    floods = (2, 1.0) if quick else (5, 1.5)
                    lines += stages.throughput(folder, programs[1], *floods)
                elif stage == "profiles":
                    seconds = 6.0 if quick else 60.0
                    found, details = stages.profiles(folder, programs[0], seconds, fifo=fifo)
                    lines += found
                elif stage == "overload":
                    lines += stages.overload(folder, 100_000, 2.0 if quick else 10.0)
                else:
                    lines += stages.bursts()
    except CloudrcError as error:
        print(f"bench-link: {error}", file=sys.stderr)
        return error.exit_code
    if options.output == "json":
        print(json.dumps({"lines": [line._asdict() for line in lines], "profiles": details}))
    else:
        _print(lines, details)
    return 0 if all(line.held for line in lines) else 1


def _print(lines: list[stages.Line], details: list[dict[str, object]]) -> None:
    system = f"Linux {platform.release()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}"
    rows: list[tuple[str, ...]] = [(system, "asked", "measured", "anchor", "")]
    rows += [(*line[:4], "" if line.held else "MISSED") for line in lines]
    print(table(rows))
    if details:
        print("\nmeasured minus drawn delay, both ways at 100 Hz; all links at the same time")
        print(table([tuple(details[0]), *(tuple(map(str, row.values())) for row in details)]))


if __name__ == "__main__":
    sys.exit(main())
