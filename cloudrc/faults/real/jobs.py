"""Faults of a mission's Job, whose pod is a process of its own that speaks with teleop's API."""

from __future__ import annotations

import re

from cloudrc.cli.client import Api, UnreachableError
from cloudrc.faults.real.kills import REAL, finish
from cloudrc.faults.real.processes import LIMIT, Processes
from cloudrc.faults.scenario import Outcome, Scenario

SOCKET = "api.sock"
KEY = "--key=job-1"


def _twice(seed: int) -> Outcome:
    outcome, api = Outcome(), f"--api=unix:{SOCKET}"
    with Processes(seed=seed, teleop=(api,)) as run:
        asked = Api(f"unix:{run.folder / SOCKET}")
        run.until("the robot is seen", lambda: _sees(asked))
        pods = [run.order(api, KEY) for _ in range(2)]
        finish(outcome, run)
        said = [pod.communicate(timeout=LIMIT)[0] for pod in pods]
        named = [re.search(r"^mission (\w+): ", text, re.MULTILINE) for text in said]
        outcome.true("both are answered with a mission", all(named))
        ids = {found[1] for found in named if found}
        outcome.same("missions that they are answered with", len(ids), 1)
        ends = {
            (pod.returncode, text.splitlines()[-1]) for pod, text in zip(pods, said, strict=True)
        }
        outcome.same("ends that they report, exit code and last line", len(ends), 1)
        made = asked.get("/v1/missions")["missions"]
        outcome.same("missions made by 2 orders under one key", len(made), 1)
        outcome.same("missions that were begun", run.events().count("started"), 1)
    return outcome


def _sees(api: Api) -> bool:
    try:
        return api.get("/v1/state")["seen"] is not None
    except UnreachableError:
        return False


SCENARIOS = (
    Scenario(
        35,
        "job-twice",
        "two processes of `cloudrc mission fly` at once, with the same key",
        "one mission, flown once; both report its end",
        "none",
        "the same mission; no metric",
        _twice,
        REAL,
    ),
)
