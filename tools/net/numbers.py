# SPDX-License-Identifier: Apache-2.0

"""Numbers of the link, the gym, evaluations, sweeps and studies."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import yaml

import cloudrc.link
from cloudrc.gym import Networked, NetworkedVector
from tools.net.flights import OWN
from tools.net.shell import cloudrc as call
from tools.net.shell import document, rows, stable

PROFILES = (
    *("5g", "handover", "ideal", "lossy", "lte", "paper-p1", "paper-p2", "paper-p3"),
    *("satellite", "wifi"),
)
PACKETS, PERIOD_NS, SIZE = 2000, 10_000_000, 300
EXECUTORS = "single", "newest", "prefix", "time_indexed", "ensemble", "broker"
SWEEP = {
    "experiment": "steps",
    "set": {"mission.steps.count": 2},
    "grid": {
        "cloud.predictor": ["last_sample", "constant_velocity"],
        "link.both.delay_ms": [0, 60],
    },
    "seeds": 2,
}
SHORT = "--set", "mission.steps.count=2"
POLICY = """\
import numpy as np


def infer(observation):
    angle, rate = observation["observation/state"][2:4]
    return {"actions": np.full((CHUNK, 1), int(angle + 0.3 * rate > 0))}
"""


def arrivals(profile: str) -> dict[str, Any]:
    """Send packets in both directions of a profile; return when each arrives [ns]."""
    found = dict[str, Any]()
    for name, way in zip(("up", "down"), cloudrc.link.open(profile, 1), strict=True):
        times = [way.send(0, n, SIZE, n * PERIOD_NS) for n in range(PACKETS)]
        text = json.dumps(times, default=str)
        found[name] = {"hash": hashlib.sha256(text.encode()).hexdigest(), "first": times[:3]}
    return found


def policy(chunk: int) -> str:
    """Write the policy of CartPole; return its path."""
    Path("law.py").write_text(POLICY.replace("CHUNK", str(chunk)))
    return "./law.py"


def evaluate(executor: str) -> dict[str, Any]:
    """Evaluate a policy with an executor over two round trips."""
    chunk = 1 if executor == "single" else 8
    words = ["eval", "--env", "CartPole-v1", "--policy", policy(chunk), "--link", "lte"]
    words += ["--rtt", "0,80", "--executor", "newest" if executor == "single" else executor]
    words += ["--seeds", "3", "--max-steps", "120", "--success-at", "120", "--compute", "0.03"]
    words += ["--deadline", "0.1", "--jobs", "1", "--out", "evals"]
    found = document(*words)
    played = [path for path in Path("evals").glob("*.jsonl")]
    return {**found, "rows": {path.name: rows(path.read_text()) for path in played}}


def networked(executor: str) -> list[Any]:
    """Play an episode of Pendulum by the wrapper; return rewards and what the robot knows."""
    env = Networked(gymnasium.make("Pendulum-v1"), "lte", executor=executor, chunk=4, compute=0.02)
    observation, info = env.reset(seed=3)
    found = [repr(observation)]
    for number in range(60):
        action = [[0.1 * ((number + k) % 7) - 0.3] for k in range(4)]
        observation, reward, *_, info = env.step(action)
        found.append([repr(observation), repr(reward), repr(info["cloudrc"])])
    return [
        found[0],
        *found[1::10],
        hashlib.sha256(repr(found).encode()).hexdigest(),
        repr(env.summary()),
    ]


def vector() -> list[Any]:
    """Play some steps of four pendulums at once."""
    make = [lambda: gymnasium.make("Pendulum-v1")] * 4
    env = NetworkedVector(gymnasium.vector.SyncVectorEnv(make), "lte", chunk=4)
    observation, _ = env.reset(seed=5)
    found = [repr(observation)]
    for number in range(40):
        observation, reward, *_ = env.step([[[0.1 * (number % 7 + k)]] * 4 for k in range(4)])
        found.append(repr((observation, reward)))
    return found[::10]


def sweep() -> dict[str, Any]:
    """Fly a sweep in two shards; return its rows, its table and what `compare` says of it."""
    Path("grid.yaml").write_text(yaml.safe_dump(SWEEP))
    codes = [
        call("sweep", "run", "grid.yaml", "--out", "out", "--shard", f"{n}/2", "--jobs", "1")[0]
        for n in (1, 2)
    ]
    text = "".join(path.read_text() for path in sorted(Path("out").glob("rows*.jsonl")))
    return {
        "exit": codes,
        "files": sorted(path.name for path in Path("out").iterdir()),
        "rows": rows(text),
        "status": document("sweep", "status", "out"),
        "compare": document("compare", "last_sample", "constant_velocity", "--in", "out"),
    }


def studies() -> dict[str, Callable[[], Any]]:
    """Return the studies by the commands that make them."""
    ways = {
        "run --seeds": ("run", "steps", "--seeds", "3", *SHORT),
        "compare": (
            *("compare", "cloud.predictor=last_sample", "cloud.predictor=constant_velocity"),
            *("--seeds", "4", *SHORT),
        ),
        "margin": ("margin", "link.both.delay_ms", "--seeds", "1", "--resolution", "40", *SHORT),
        "link show": ("link", "show", "lte"),
        "robot check": ("robot", "check", "x2"),
    }
    return {name: partial(document, *words) for name, words in ways.items()}


def identify() -> dict[str, Any]:
    """Fit the model of a recorded flight, and replay its report."""
    words = "run", "steps", "--mode", "virtual", "--set", "link.profile=ideal", "--out", "run"
    found = {"run": document(*words), "identify": document("identify", "run")}
    found["report"] = document("report", "run", "--metric", str(OWN / "metric.py"))
    Path("trace.csv").unlink(missing_ok=True)
    code, out, err = call("link", "record", "run", "-o", "trace.csv")
    found["record"] = {"exit": code, "said": out + err}
    if Path("trace.csv").exists():
        found["record"]["hash"] = hashlib.sha256(Path("trace.csv").read_bytes()).hexdigest()
    return found


def exercise() -> dict[str, Any]:
    """Hand out the exercise, and score it as it was handed out."""
    call("class", "new", "exercise")
    code, out, _ = call("class", "check", "exercise", "-o", "gradescope")
    return {"exit": code, "document": stable(json.loads(out))}


def tasks() -> dict[str, Callable[[], Any]]:
    """Return all tasks of this part."""
    found: dict[str, Callable[[], Any]] = studies()
    found |= {f"arrivals {profile}": partial(arrivals, profile) for profile in PROFILES}
    found |= {f"eval {name}": partial(evaluate, name) for name in EXECUTORS}
    found |= {f"networked {name}": partial(networked, name) for name in EXECUTORS[1:]}
    found |= {"vector": vector, "sweep": sweep, "identify": identify, "class check": exercise}
    return found
