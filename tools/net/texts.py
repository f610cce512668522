# SPDX-License-Identifier: Apache-2.0

"""Texts and files that programs depend on: help, lists, pages, schemas, charts, exit codes."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import distribution
from pathlib import Path
from typing import Any

import yaml
from mcap.reader import make_reader

from cloudrc.cli.parser import COMMANDS
from tools.net.shell import cloudrc as call
from tools.net.shell import document, stable

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "charts" / "cloudrc"
PAGES = "experiment.md", "topics.md", "metrics.md"
"""Pages of docs/ whose tables are made from the code."""
RIGHT = """\
list
list predictors
list robots -o json
list profiles -o yaml
doctor
robot check nano
robot check rover -o json
link show paper-p1
link show lossy -o json
run hover --mode virtual --out a
run steps --mode virtual --set mission.steps.count=1 -o json --out b
run paper --mode virtual --set link.profile=ideal --set cloud.predictor=last_sample --out c
run steps --seeds 2 --set mission.steps.count=1
new robot mine
key new --help
completion bash
class new course
margin cloud.plan_s --help
compare --help
eval --help
policy --help
relay --help
mission list --run nothing
down --help
console --help
report --help
"""
WRONG = """\
fly
run nothing
run paper --mode fast
run paper --seed x
run paper --seed -1
run paper --seeds 0
run paper --set
run paper --set link.profil=lte
run paper --set link.profile=nothing
run paper --set link.uplink.loss=2
run paper --set link.uplink.delay_ms=-1
run paper --set world.robot=nothing
run paper --set cloud.predictor=nothing
run paper --set cloud.predictor=./nothing.py
run paper --set mission.waypoints.0.position_m=[0,0,9]
run paper --set mission=nothing
run nothing.yaml
run fast --mode virtual --set world.robot=nano
list nothing
link show nothing
link set downlink.delay_ms=10 --run nothing
link record nothing.csv
report nothing
identify nothing
replay nothing
recover nothing
sweep run nothing.yaml
sweep status nothing
sweep run grid.yaml --shard 3/2
compare a b
compare cloud.predictor=pid cloud.predictor=last_sample
margin nothing
margin link.both.delay_ms --seeds 0
eval --env CartPole-v1
eval --env CartPole-v1 --policy nothing.py
eval --env Nothing-v0 --policy ./law.py
class check nothing
robot check nothing
mission run nothing --run nothing
"""


def said(line: str) -> dict[str, Any]:
    """Run a command; return its exit code, and the first line of its output or of its error."""
    code, out, err = call(*line.split())
    return {"exit": code, "said": (err if code > 1 else out).split("\n")[0]}


def helps() -> dict[str, str]:
    """Return the help of the program, of its commands and of their verbs."""
    found = dict[str, str]()

    def read(*words: str) -> None:
        _, text, _ = call(*words, "--help")
        found[" ".join(words) or "cloudrc"] = text
        for below in _listed(text) if words else COMMANDS:
            if len(words) < 2:
                read(*words, below)

    read()
    return found


def _listed(text: str) -> list[str]:
    """Return the verbs that the help of a command lists."""
    listed = text.partition("verbs:")[2].partition("\n\n")[0]
    return re.findall(r"^ {2,4}([a-z][\w-]*) {2,}", listed, re.MULTILINE)


def page(name: str) -> list[str]:
    """Return the rows of the tables of a page."""
    lines = (ROOT / "docs" / name).read_text().splitlines()
    return [line for line in lines if line.startswith("|")]


def openapi() -> Any:
    """Start teleop, and ask it for the description of its API."""
    call("run", "hover", "--mode", "virtual", "--out", "run")
    Path("operator").write_text("a-token-of-the-net-and-long-enough\n")
    Path("operator").chmod(0o600)
    words = "teleop --config run/config.yaml --socket . --api 0 --api-file api.json --tokens ."
    command = [sys.executable, "-m", "cloudrc", *words.split()]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as teleop:
        try:
            for _ in range(200):
                if Path("api.json").exists():
                    break
                time.sleep(0.05)
            url = json.loads(Path("api.json").read_text())["url"]
            request = urllib.request.Request(f"{url}/openapi.json")
            request.add_header("Authorization", f"Bearer {Path('operator').read_text().strip()}")
            with urllib.request.urlopen(request, timeout=20) as answer:
                return json.loads(answer.read())
        finally:
            teleop.terminate()


def recording() -> dict[str, Any]:
    """Fly with a recording; return the files of the run, the report, and the topics' schemas."""
    call("run", "paper", "--mode", "virtual", "--out", "run")
    with open("run/mission.mcap", "rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = {
        channel.topic: [
            channel.message_encoding,
            summary.schemas[channel.schema_id].name,
            summary.schemas[channel.schema_id].data.decode(errors="replace"),
        ]
        for channel in summary.channels.values()
    }
    report = stable(json.loads(Path("run/report.json").read_text()))
    files = sorted(str(path.relative_to("run")) for path in Path("run").rglob("*"))
    return {"files": files, "report": report, "topics": topics}


def entry_points() -> list[str]:
    """Return the program's entry points and extras."""
    ours = distribution("cloudrc")
    return [*sorted(map(str, ours.entry_points)), *sorted(ours.metadata.get_all("Provides-Extra"))]


def chart(values: Path) -> list[str]:
    """Render the chart with a file of values; return its objects."""
    if shutil.which("helm") is None:
        return ["helm is missing"]
    command = ["helm", "template", "net", str(CHART), "--values", str(values)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return [done.stderr]
    things = [each for each in yaml.safe_load_all(done.stdout) if each]
    for secret in [each for each in things if each["kind"] == "Secret"]:
        secret["data"] = sorted(secret["data"])  # the values are random
    return [yaml.safe_dump(each) for each in things]


def _charts() -> Iterator[Path]:
    yield from sorted((CHART / "ci").glob("*.yaml"))
    yield from sorted((CHART / "examples").glob("values-*.yaml"))


def tasks() -> dict[str, Callable[[], Any]]:
    """Return all tasks of this part."""
    found: dict[str, Callable[[], Any]] = {
        "helps": helps,
        "list": partial(document, "list"),
        "openapi": openapi,
        "recording": recording,
        "entry points": entry_points,
    }
    found |= {f"page {name}": partial(page, name) for name in PAGES}
    found |= {f"chart {path.relative_to(CHART)}": partial(chart, path) for path in _charts()}
    for line in (RIGHT + WRONG).splitlines():
        found[f"cloudrc {line}"] = partial(said, line)
    return found
