"""Measure over which round trips Meta-World's scripted experts do their tasks.

Writes table and figure of docs/eval.md. Run as `make meta-world`: Meta-World pins an old MuJoCo, so
that it needs an environment of its own. The evaluations stay in `build/meta-world-evals`, where a
later call of the same code goes on. `--seeds 4` is faster and only prints the table.
"""

from __future__ import annotations

import argparse
import json
import sys
from math import nan
from pathlib import Path
from typing import Any

from cloudrc.cli.main import main as cloudrc
from cloudrc.report.figures.bands import Panel, Point, draw
from cloudrc.report.figures.style import Look
from cloudrc.source import code_hash

ROOT = Path(__file__).parents[1]
PAGE, FIGURE = ROOT / "docs" / "eval.md", ROOT / "docs" / "meta-world.png"
FOLDER = ROOT / "build" / "meta-world-evals"
BEGIN, END = "<!-- make meta-world: begin -->\n", "<!-- make meta-world: end -->\n"
TASKS = ("reach-v3", "push-v3", "pick-place-v3", "door-open-v3")
ROUND_TRIPS = "0,50,100,150,300,600"  # [ms]
SEEDS = 20
STEPS = 300  # of an episode, 12.5 ms each
EXPERT = """\
from metaworld.policies import ENV_POLICY_MAP

expert = ENV_POLICY_MAP["{task}"]()


def infer(observation):
    action = expert.get_action(observation["observation/state"])
    return {{"actions": [action.clip(-1.0, 1.0)]}}
"""
Outcome = dict[str, Any]


def evaluate(task: str, seeds: int) -> list[Outcome]:
    """Evaluate the expert of a task; return its outcomes, the first without a network."""
    folder = FOLDER / code_hash()
    folder.mkdir(parents=True, exist_ok=True)
    policy = folder / f"{task}.py"
    policy.write_text(EXPERT.format(task=task))
    words = ["eval", "--env", "metaworld:Meta-World/MT1", "--env-arg", f"env_name={task}"]
    words += ["--env-arg", "seed={seed}", "--policy", str(policy), "--link", "lte"]
    words += ["--rtt", ROUND_TRIPS, "--max-steps", str(STEPS), "--seeds", str(seeds)]
    if code := cloudrc([*words, "--out", str(folder / task)]):
        sys.exit(code)
    outcomes: list[Outcome] = json.loads((folder / task / "eval.json").read_text())["outcomes"]
    return outcomes


def point(outcome: Outcome) -> Point:
    """Return the share of successes [%], with its 95 % interval."""
    share, low, high = (100 * outcome[f"success{end}"] for end in ("", "_low", "_high"))
    return Point(outcome["loop_age_ms"], share, low, high, failed=False)


def table(found: dict[str, list[Outcome]], seeds: int) -> str:
    """Return the table of the page: a row without a network and one per round trip."""
    lines = [
        f"In how many of {seeds} episodes four experts do their tasks within {STEPS} steps of "
        "12.5 ms, with the 95 %\ninterval of the rate:\n",
        "![Success of four experts over the age of the loop, with 95 % intervals]"
        f"({FIGURE.name})\n",
        f"| round trip [ms] | {' | '.join(found)} |",
        "|---" * (len(found) + 1) + "|",
    ]
    for row in zip(*found.values(), strict=True):
        cells = []
        for each in row:
            low, high = (100 * each[f"success_{end}"] for end in ("low", "high"))
            cells.append(f"{each['successes']} ({low:.0f}-{high:.0f} %)")
        rtt = row[0]["rtt_ms"]
        name = "no network" if rtt is None else f"{rtt:g}"
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main() -> None:
    """Evaluate all experts; write page and figure, unless there are fewer seeds."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=SEEDS)
    seeds = parser.parse_args().seeds
    found = {task: evaluate(task, seeds) for task in TASKS}
    made = table(found, seeds)
    print(made)
    if seeds < SEEDS:
        return
    lines = {task: [point(each) for each in outcomes[1:]] for task, outcomes in found.items()}
    without = {100 * outcomes[0]["success"] for outcomes in found.values()}
    panels = [Panel("success", "%", lines, without.pop() if len(without) == 1 else nan)]
    FIGURE.write_bytes(draw(panels, "age of the loop_ms", [], "task", look=Look(width=5.0))["png"])
    before, _, rest = PAGE.read_text().partition(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}\n{made}\n{END}{rest.partition(END)[2]}")


if __name__ == "__main__":
    main()
