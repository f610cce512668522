"""The cluster as the tests see it: kubectl and helm, one release, what to save on failure."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from prometheus_client.parser import text_string_to_metric_families

from cloudrc.cli.client import Api
from cloudrc.cluster.client import Release, connect
from cloudrc.cluster.pods import api_url, fetch_metrics, operator_token

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "charts" / "cloudrc"
EXAMPLES = CHART / "examples"
NAMESPACE = "cloudrc-e2e"
NAMESPACES = (NAMESPACE, f"{NAMESPACE}-monitoring", f"{NAMESPACE}-bad")
"""All that these tests make."""
NAME = "cloudrc"
RESTRICTED = {"pod-security.kubernetes.io/enforce": "restricted"}
SUMMARY: list[str] = []
"""Lines that are printed at the end."""
TIMES: dict[str, float] = {}
"""Instants of the session [s]."""


class CommandFailedError(AssertionError):
    """A command ended with another code than 0."""


def command(
    *words: str | Path, given: str = "", timeout: float = 120.0, environ: Mapping[str, str] = {}
) -> str:
    """Run a command; what it wrote."""
    done = subprocess.run(
        [str(word) for word in words],
        input=given,
        capture_output=True,
        text=True,
        timeout=timeout,
        cwd=ROOT,
        env={**os.environ, **environ},
    )
    if done.returncode != 0:
        line = " ".join(map(str, words))
        raise CommandFailedError(f"{line}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def kubectl(*words: str, given: str = "", timeout: float = 120.0) -> str:
    """In the namespace of the tests, unless the words name another."""
    return command("kubectl", f"--namespace={NAMESPACE}", *words, given=given, timeout=timeout)


def read(*words: str) -> Any:
    """What `kubectl get` says, as values."""
    return json.loads(kubectl("get", *words, "--output=json"))


def apply(*documents: Mapping[str, Any]) -> None:
    kubectl("apply", "--filename=-", given=yaml.safe_dump_all(documents))


def helm(*words: str, timeout: float = 180.0) -> str:
    return command("helm", f"--namespace={NAMESPACE}", *words, timeout=timeout)


def cloudrc(*words: str, timeout: float = 240.0) -> subprocess.CompletedProcess[str]:
    """Run our own command line, whatever it ends with."""
    return subprocess.run(
        [sys.executable, "-m", "cloudrc", *words],
        capture_output=True,
        text=True,
        timeout=timeout,
        cwd=ROOT,
    )


def eventually(
    look: Callable[[], Any], what: str, timeout: float = 30.0, every: float = 0.5
) -> Any:
    """Look until something is true; what was seen."""
    until = time.monotonic() + timeout
    while True:
        seen = look()
        if seen:
            return seen
        assert time.monotonic() < until, f"not within {timeout:g} s: {what}"
        time.sleep(every)


def place() -> Release:
    return connect(None, NAMESPACE, NAME)


def pods(component: str) -> list[dict[str, Any]]:
    selector = f"app.kubernetes.io/instance={NAME},app.kubernetes.io/component={component}"
    return read("pods", f"--selector={selector}")["items"]


def pod(component: str) -> dict[str, Any]:
    """The component's pod that is not about to end."""
    (found,) = [p for p in pods(component) if "deletionTimestamp" not in p["metadata"]]
    return found


def identity() -> dict[str, tuple[str, list[int]]]:
    """What changes when a pod is replaced or a container starts again."""
    found = {}
    for component in ("world", "cloud"):
        one = pod(component)
        status = one["status"]
        containers = [*status.get("initContainerStatuses", []), *status["containerStatuses"]]
        found[component] = one["metadata"]["uid"], [c["restartCount"] for c in containers]
    return found


Sample = tuple[str, tuple[tuple[str, str], ...]]


def scrapes(component: str) -> dict[str, str]:
    """What each container of a pod answers to a scrape."""
    return fetch_metrics(place(), component)


def metrics(component: str, container: str = "") -> dict[Sample, float]:
    """Every sample of a container: by name and sorted labels."""
    text = scrapes(component)[container or component]
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def value(samples: Mapping[Sample, float], name: str, **labels: str) -> float:
    """Sum of the samples of a name whose labels include these."""
    found = [
        number
        for (each, given), number in samples.items()
        if each == name and labels.items() <= dict(given).items()
    ]
    assert found, f"no sample {name} {labels}"
    return sum(found)


def missions() -> list[dict[str, Any]]:
    """All missions that the API knows, oldest first."""
    token = operator_token(connect(None, NAMESPACE, NAME))
    with api_url(None, NAMESPACE, NAME) as url:
        return list(Api(url, lambda: token).get("/v1/missions")["missions"])


@dataclass
class JobEnd:
    """How a Job ended."""

    name: str
    condition: str
    exit_code: int
    message: str
    log: str = field(repr=False, default="")


def job_end(name: str, timeout: float = 150.0) -> JobEnd:
    """Wait for a Job and read its verdict as `kubectl describe` would show it."""

    def ended() -> str:
        conditions = read("job", name)["status"].get("conditions", [])
        true = [c["type"] for c in conditions if c["status"] == "True"]
        return next((c for c in true if c in ("Complete", "Failed")), "")

    condition = eventually(ended, f"Job {name} has ended", timeout)
    (one,) = read("pods", f"--selector=batch.kubernetes.io/job-name={name}")["items"]
    terminated = one["status"]["containerStatuses"][0]["state"]["terminated"]
    log = kubectl("logs", one["metadata"]["name"])
    return JobEnd(name, condition, terminated["exitCode"], terminated.get("message", ""), log)


def job_log(name: str) -> str:
    """What a Job has said so far; "" while its pod does not run."""
    try:
        return kubectl("logs", f"job/{name}")
    except CommandFailedError:
        return ""


def fly(name: str, waypoints: Sequence[Mapping[str, Any]], limit: float = 60.0) -> None:
    """Fly waypoints by a Job of this name, as `cloudrc mission run` does."""
    from cloudrc.cluster.jobs import run_job

    mission = {"name": name, "time_limit_s": limit, "waypoints": list(waypoints)}
    run_job(place(), mission, name=name, limit=limit)


def save(folder: Path) -> None:
    """Keep what helps to understand a failure: of each namespace in a folder of its own."""
    for namespace in NAMESPACES:
        _save_texts(folder / namespace, f"--namespace={namespace}")
    for component in ("world", "cloud"):
        for one in pods(component):
            name = one["metadata"]["name"]
            path = f"/var/lib/cloudrc/{component}.mcap"
            words = [
                "kubectl",
                f"--namespace={NAMESPACE}",
                "exec",
                name,
                f"--container={component}",
            ]
            with (folder / f"{name}.mcap").open("wb") as file:
                subprocess.run([*words, "--", "cat", path], stdout=file, stderr=-3, timeout=60)


def _save_texts(folder: Path, where: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)

    def keep(name: str, *words: str) -> None:
        try:
            text = kubectl(where, *words, timeout=30.0)
        except (CommandFailedError, subprocess.TimeoutExpired) as error:
            text = str(error)
        (folder / name).write_text(text)

    keep("objects.txt", "get", "all,configmap,networkpolicy,pvc,secret", "--output=wide")
    keep("events.txt", "get", "events", "--sort-by=.lastTimestamp")
    keep("describe.txt", "describe", "pods,jobs")
    for one in read("pods", where)["items"]:
        name = one["metadata"]["name"]
        keep(f"{name}.log", "logs", name, "--all-containers", "--prefix", "--timestamps")
        if any(c["restartCount"] for c in one["status"].get("containerStatuses", [])):
            keep(f"{name}.previous.log", "logs", name, "--all-containers", "--prefix", "--previous")
