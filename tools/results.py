"""Write the tables of results in README.md: `make results` flies seeds 1 to 10 in two minutes.

A nightly test flies again: each number in the README must lie within the interval of its sweep.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tools.docs import table

README = Path(__file__).resolve().parents[1] / "README.md"
SEEDS = 10
LINKS = {"paper-p1": "20 ± 10 ms", "paper-p2": "45 ± 25 ms", "paper-p3": "70 ± 40 ms"}
"""Link profile of the paper -> delay ± jitter, each way."""
NUMBERS = {
    "contact_time": (1.0, "s", 1),
    "min_clearance": (1.0, "m", 3),
    "tip_speed": (1.0, "m/s", 3),
    "steady_contact_force": (1.0, "N", 2),
}
"""Metric in the table of links -> factor to its unit, the unit, and the number of decimals."""
PREDICTORS = ("constant_acceleration", "constant_velocity", "commanded_velocity", "last_sample")


def sweep(experiment: str, *settings: str) -> dict[str, Any]:
    """Fly an experiment with seeds 1 to 10; return the content of sweep.json."""
    with TemporaryDirectory() as folder:
        words = [word for setting in settings for word in ("--set", setting)]
        command = [sys.executable, "-m", "cloudrc", "run", experiment, f"--seeds={SEEDS}", *words]
        subprocess.run([*command, f"--out={folder}/sweep"], check=False, stdout=subprocess.DEVNULL)
        found: dict[str, Any] = json.loads(Path(folder, "sweep", "sweep.json").read_text())
    return found


def links() -> Iterator[tuple[str, ...]]:
    """Yield a row for each link of the paper: the mission's numbers, medians."""
    for profile, words in LINKS.items():
        found = sweep("paper", f"link.profile={profile}")
        values = (
            f"{found['numbers'][name]['median'] * factor:.{digits}f} {unit}"
            for name, (factor, unit, digits) in NUMBERS.items()
        )
        yield f"`{profile}`, {words}", f"{found['done']}/{found['count']}", *values


def predictors() -> Iterator[tuple[str, ...]]:
    """Yield a row for each predictor: its prediction error with a 95 % interval."""
    for name in PREDICTORS:
        found = sweep("steps", f"cloud.predictor={name}")
        error = found["numbers"]["prediction_error_rms"]
        middle, low, high = (1e3 * value for value in (error["median"], *error["interval"]))
        yield f"`{name}`", f"{middle:.1f} mm [{low:.1f}, {high:.1f}]"


def main() -> None:
    """Fly everything and write both tables between their marks."""
    text = README.read_text(encoding="utf-8")
    for mark, made in (
        ("links", table("link | missions done | contact at | smallest clearance in the pipes | "
                        "tip speed at contact | steady force", links())),
        ("predictors", table("predictor | prediction error, RMS", predictors())),
    ):  # fmt: skip
        before, begin, rest = text.partition(f"<!-- made by `make results`: {mark} -->\n")
        _, end, after = rest.partition("<!-- end -->\n")
        assert begin, f"README.md has no mark of the table {mark}"
        assert end, f"README.md has no end of the table {mark}"
        text = f"{before}{begin}{made}{end}{after}"
    README.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
