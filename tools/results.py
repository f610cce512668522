# SPDX-License-Identifier: Apache-2.0

"""Write tables and pictures of docs/results.md, docs/reproduce.md and README.md: `make results`.

A nightly test flies again: each number in the table must lie within the interval of its sweep.
"""

from __future__ import annotations

import json
import shutil
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cloudrc.base.statistics import median_interval
from cloudrc.studies.reproduce.table import as_markdown, summary
from tools.docs import insert
from tools.markdown import table

ROOT = Path(__file__).resolve().parents[1]
PAGE, SWEEPS = ROOT / "docs" / "results.md", ROOT / "docs" / "sweeps"
LINKS = "paper-p3", "far"
"""Link profiles in `predictors.yaml`."""
ERROR = "prediction_error_rms"
IN_README = 2, 3, 4, 5, 6
"""Numbers of the paper's statements in README.md."""


def cloudrc(*words: str | Path) -> None:
    """Run cloudrc; a sweep with failed flights is a result, too."""
    subprocess.run([sys.executable, "-m", "cloudrc", *map(str, words)], check=False)


def fly(name: str, folder: Path) -> list[dict[str, Any]]:
    """Fly a sweep of the documentation into a folder; return its rows."""
    cloudrc("sweep", "run", SWEEPS / f"{name}.yaml", "--out", folder)
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


def results(rows: list[dict[str, Any]]) -> dict[str, tuple[list[float], list[int]]]:
    """Return per predictor: its errors over the first link [mm], its successes over each link."""
    found = {}
    for name in dict.fromkeys(row["point"]["predictor"] for row in rows):
        mine = [row for row in rows if row["point"]["predictor"] == name]
        near, far = ([row for row in mine if row["point"]["link"] == link] for link in LINKS)
        done = [sum(row["verdict"] == "success" for row in part) for part in (near, far)]
        found[name] = [1e3 * row["numbers"][ERROR] for row in near], done
    return found


def cells(rows: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    """Yield the table's row for each predictor, the largest error first."""
    found = results(rows)
    for name in sorted(found, key=lambda name: -statistics.median(found[name][0])):
        errors, done = found[name]
        low, high = median_interval(errors) or (float("nan"), float("nan"))
        middle = f"{statistics.median(errors):.1f} mm [{low:.1f}, {high:.1f}]"
        yield f"`{name}`", middle, *(f"{count}/{len(errors)}" for count in done)


def draw_policy(folder: Path) -> None:
    """Play the policy of the tutorial, as docs/results.md says; draw what it survives."""
    tutorial = (ROOT / "docs" / "tutorials" / "policy.md").read_text(encoding="utf-8")
    _, _, rest = tutorial.partition("<!-- test: chunk.py -->\n```python\n")
    (policy := folder / "chunk.py").write_text(rest.partition("```")[0], encoding="utf-8")
    link = "--link lte --rtt 0,50,100,200,300 --executor newest,time-indexed,broker"
    words = f"--env CartPole-v1 {link} --success-at 500 --seeds 20".split()
    cloudrc("eval", *words, "--policy", policy, "--out", folder / "policy")
    shutil.copy(folder / "policy" / "figure.png", ROOT / "docs" / "survival.png")


def beside_the_paper(folder: Path) -> dict[Path, str]:
    """Return the pages that show the statements of the paper, after `cloudrc reproduce`."""
    document = json.loads((folder / "reproduce.json").read_text())
    return {
        **insert(ROOT / "docs" / "reproduce.md", f"\n{as_markdown(document)}"),
        **insert(ROOT / "README.md", f"\n{summary(document, IN_README)}\n\n"),
    }


def main() -> None:
    """Fly both sweeps and play a policy; write the table and the pictures of the page."""
    with TemporaryDirectory() as folder:
        made = table(
            "predictor | prediction error at 70 ± 40 ms | successful flights at 70 ± 40 ms | "
            "successful flights at 200 ± 40 ms, 10 % loss",
            cells(fly("predictors", Path(folder, "predictors"))),
        )
        fly("delay", delay := Path(folder, "delay"))
        cloudrc("sweep", "figure", delay, "--metric", ERROR, "--by", "predictor")
        shutil.copy(delay / "figure.png", ROOT / "docs" / "delay.png")
        draw_policy(Path(folder))
        cloudrc("reproduce", "-o", paper := Path(folder, "paper"))
        shutil.copy(paper / "reproduce.png", ROOT / "docs" / "reproduce.png")
        pages = beside_the_paper(paper)
    for page, text in {**pages, **insert(PAGE, made)}.items():
        page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
