"""Compare this working tree with an older commit: the same flights must give the same results.

`python -m tools.net` flies experiments in virtual time with both trees. All numbers, the verdict,
failure codes, exit code and every recorded column except free text must be equal, bit by bit. Texts
are compared, too: schemas without descriptions, rendered charts, /metrics, topics, `--help`.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import product
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
BASE = "74e7f90"
WORK = ROOT / "build" / "net"
EXPERIMENTS = ("paper", "paper-verbatim", "steps", "hover")
PROFILES = ("paper-p1", "paper-p2", "paper-p3", "lossy", "satellite")
SEEDS = (1, 2)

# Runs inside of each tree: the recorded columns of a file, each as a hash of its bytes.
COLUMNS = """
import hashlib, json, re, sys
from pathlib import Path
from cloudrc.record.columns import Recording
from mcap.reader import make_reader
path = Path(sys.argv[1])
recording = Recording.read(path)
with path.open("rb") as file:
    summary = make_reader(file).get_summary()
found = {}
for channel in summary.channels.values():
    table = recording[channel.topic]
    for name in table.names:
        column = table[name]
        if column.dtype != object:
            digest = hashlib.sha256(column.tobytes()).hexdigest()[:16]
            found[f"{channel.topic} {name} {column.dtype} {column.shape}"] = digest
bare = lambda text: re.sub(r"[ \\t]*#.*", "", text)  # a definition's comments are prose
kinds = {schema.name: bare(schema.data.decode()) for schema in summary.schemas.values()}
topics = {c.topic: summary.schemas[c.schema_id].name for c in summary.channels.values()}
print(json.dumps({"columns": found, "topics": topics, "definitions": kinds}))
"""
SCHEMA = """
import json
from cloudrc.config.schema import Experiment
print(json.dumps(Experiment.model_json_schema()))
"""


class Tree:
    """A checkout of the project, and the programs that run in it."""

    def __init__(self, path: Path, out: Path) -> None:
        """Use the checkout at `path`; write results to `out`."""
        self.path, self.out = path, out
        self.environment = {**os.environ, "PYTHONPATH": str(path), "COLUMNS": "80"}
        self.environment.pop("CI", None)

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """Run Python with the package of this tree."""
        command = [sys.executable, *arguments]
        return subprocess.run(
            command, cwd=self.path, env=self.environment, capture_output=True, text=True
        )

    def fly(self, experiment: str, profile: str, seed: int) -> dict[str, Any]:
        """Fly one experiment in virtual time, and store what is compared."""
        folder = self.out / f"{experiment}-{profile}-{seed}"
        flags = ["--mode", "virtual", "--seed", str(seed), "--set", f"link.profile={profile}"]
        flags += ["--out", str(folder), "-o", "json"]
        ended = self.python("-m", "cloudrc", "run", experiment, *flags)
        report = json.loads(ended.stdout)
        read = json.loads(self.python("-c", COLUMNS, str(folder / "mission.mcap")).stdout)
        return {
            "exit code": ended.returncode,
            "verdict": report["verdict"],
            "failures": [failure["code"] for failure in report["failures"]],
            "numbers": report["numbers"],
            "records_sha256": report["records_sha256"],
            **read,
        }

    def texts(self) -> dict[str, Any]:
        """Collect the texts that users type or parse."""
        values = json.loads((self.path / "charts/cloudrc/values.schema.json").read_text())
        return {
            "experiment schema": bare(json.loads(self.python("-c", SCHEMA).stdout)),
            "chart schema": bare(values),
            "charts": dict(self.charts()),
            "metrics": self.metrics(),
            "help": dict(self.help()),
        }

    def charts(self) -> Iterator[tuple[str, str]]:
        """Render the chart with each file of test values."""
        chart = self.path / "charts" / "cloudrc"
        for values in sorted(chart.glob("ci/*-values.yaml")):
            command = ["helm", "template", "net", str(chart), "--kube-version", "1.34", "--values"]
            command.append(str(values))
            text = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            # Each rendering makes new Secrets, and comments are prose.
            text = re.sub(r"(?m)^(\s+(key|operator|reader|psk)[\w.-]*: ).*$", r"\1made anew", text)
            yield values.name, re.sub(r"(?m)^\s*#.*\n", "", text)

    def metrics(self) -> dict[str, list[str]]:
        """Read the metrics of world and cloud in flight: name, type and labels of each series."""
        self.out.mkdir(parents=True, exist_ok=True)
        (self.out / "key").write_bytes(bytes(range(32)))
        ports = {"world": (47310, 47311, 47312), "cloud": (47311, 47310, 47313)}
        processes = []
        for end, (listen, peer, serve) in ports.items():
            flags = ["--config", str(self.path / "cloudrc/experiments/paper.yaml")]
            flags += ["--key", str(self.out / "key"), "--listen", f"127.0.0.1:{listen}"]
            flags += ["--peer", f"127.0.0.1:{peer}", "--metrics", f"127.0.0.1:{serve}"]
            command = [sys.executable, "-m", "cloudrc", end, *flags]
            processes.append(
                subprocess.Popen(
                    command, cwd=self.path, env=self.environment, stdout=subprocess.DEVNULL
                )
            )
        found = {}
        try:
            time.sleep(12)  # world and cloud meet, and the mission starts
            for end, (*_, serve) in ports.items():
                with urllib.request.urlopen(f"http://127.0.0.1:{serve}/metrics") as answer:
                    found[end] = sorted(series(answer.read().decode()))
        finally:
            for process in processes:
                process.terminate()
                process.wait(10)
        return found

    def help(self) -> Iterator[tuple[str, list[str]]]:
        """Collect the names and options of all commands."""
        todo: list[tuple[str, ...]] = [()]
        while todo:
            verb = todo.pop()
            text = self.python("-m", "cloudrc", *verb, "--help").stdout
            usage = text.partition("\n\n")[0]
            yield " ".join(verb), sorted(set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", usage)))
            names = re.findall(r"(?m)^    ([a-z]+)(?:  |$)", text) if len(verb) == 1 else []
            if not verb:
                names = re.findall(r"(?m)^  ([a-z]+) {2,}\S", text)
            todo += [(*verb, name) for name in names if len(verb) < 2 and name not in verb]


def series(text: str) -> set[str]:
    """List name, type and label names of each series in the text of /metrics."""
    kinds = dict(re.findall(r"(?m)^# TYPE (\S+) (\S+)$", text))
    found = set()
    for name, labels in re.findall(r"(?m)^([a-z]\w*)(?:\{(.*?)\})? ", text):
        whole = next(
            (k for k in (name, re.sub(r"_(bucket|sum|count)$", "", name)) if k in kinds), ""
        )
        names = ",".join(sorted(re.findall(r'(\w+)="', labels)))
        found.add(f"{name} {kinds.get(whole, '')} {{{names}}}")
    return found


def bare(schema: Any) -> Any:
    """Remove descriptions and titles from a JSON schema."""
    if isinstance(schema, dict):
        return {
            key: bare(value)
            for key, value in schema.items()
            if not (key in ("description", "title") and isinstance(value, str))
        }
    return [bare(item) for item in schema] if isinstance(schema, list) else schema


def differences(old: Any, new: Any, path: str = "") -> Iterator[str]:
    """List the differences between two documents, each with its path."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(key for key in new if key not in old)]:
            if key not in new or key not in old:
                yield f"{path}/{key}: {'gone' if key in old else 'new'}"
            else:
                yield from differences(old[key], new[key], f"{path}/{key}")
    elif old != new:
        if isinstance(old, list) and isinstance(new, list):
            gone = [item for item in old if item not in new]
            added = [item for item in new if item not in old]
            yield f"{path}: gone {gone}, new {added}"
        elif isinstance(old, str) and "\n" in old:
            yield f"{path}: {len(old.splitlines())} lines, {len(new.splitlines())} lines"
        else:
            yield f"{path}: {old!r} is now {new!r}"


def main() -> int:
    """Compare both trees; return 1 if anything differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hash", action="store_true", help="compare records_sha256 as well")
    parser.add_argument("--only", default="", help="flights whose name holds this")
    options = parser.parse_args()
    base = WORK / "base"
    if not base.exists():
        subprocess.run(["git", "worktree", "prune"], cwd=ROOT, check=True)
        subprocess.run(
            ["git", "worktree", "add", "--detach", str(base), BASE], cwd=ROOT, check=True
        )
    run = WORK / f"new-{time.strftime('%H%M%S')}"
    old, new = Tree(base, WORK / "old"), Tree(ROOT, run)
    flights = [
        f for f in product(EXPERIMENTS, PROFILES, SEEDS) if options.only in "-".join(map(str, f))
    ]
    failed = 0

    def kept(flight: tuple[str, str, int]) -> dict[str, Any]:
        store = WORK / f"old-{'-'.join(map(str, flight))}.json"
        if not store.exists():
            store.write_text(json.dumps(old.fly(*flight)))
        result: dict[str, Any] = json.loads(store.read_text())
        return result

    with ThreadPoolExecutor(2) as pool:
        before = list(pool.map(kept, flights))
        after = list(pool.map(lambda flight: new.fly(*flight), flights))
    for flight, was, now in zip(flights, before, after, strict=True):
        if not options.hash:
            was.pop("records_sha256"), now.pop("records_sha256")
        found = list(differences(was, now))
        failed += bool(found)
        print(*flight, "differs" if found else f"equal: {len(was['columns'])} columns")
        for line in found[:20]:
            print("   ", line)
    if not options.only:
        for line in differences(old.texts(), json.loads(json.dumps(new.texts()))):
            failed += 1
            print("text:", line)
    print(f"{len(flights)} flights; {failed} differences" if failed else "all equal")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
