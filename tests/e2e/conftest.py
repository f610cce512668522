"""A cluster for the end-to-end tests: made or found, given the images, and taken down again."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml
from kube import (
    CHART,
    NAME,
    NAMESPACE,
    NAMESPACES,
    RESTRICTED,
    ROOT,
    SUMMARY,
    TIMES,
    apply,
    command,
    helm,
    kubectl,
    place,
    save,
)

CLUSTER = "cloudrc-e2e"
IMAGES = "world cloud prometheus"  # a real Prometheus is for these tests alone
BUILD = ROOT / "build" / "e2e"
TOOLS = {
    "docker": "https://docs.docker.com/engine/install/",
    "kind": "https://kind.sigs.k8s.io/",
    "helm": "https://helm.sh/docs/intro/install/",
    "kubectl": "https://kubernetes.io/docs/tasks/tools/",
}
MISSING_PREREQUISITE = 3
UP = pytest.StashKey[bool]()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--keep", action="store_true", help="leave the kind cluster for a look")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.e2e)


@pytest.fixture(scope="session")
def note() -> Callable[[str], None]:
    """Add a line to the summary."""
    return SUMMARY.append


@pytest.fixture(scope="session")
def cluster(request: pytest.FixtureRequest) -> Iterator[None]:
    """A cluster with our images in it: that of KUBECONFIG, or a kind cluster of our own."""
    own = "KUBECONFIG" not in os.environ
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        where = "; ".join(f"{tool}: {TOOLS[tool]}" for tool in missing)
        pytest.exit(
            f"e2e needs {', '.join(missing)}, not installed ({where})", MISSING_PREREQUISITE
        )
    BUILD.mkdir(parents=True, exist_ok=True)
    for folder in BUILD.iterdir():
        if folder.is_dir():  # of an earlier session; the kubeconfig beside them may be in use
            shutil.rmtree(folder)
    command("make", "images", f"IMAGES={IMAGES}", timeout=1800)
    TIMES["create"] = time.monotonic()
    try:
        if own:
            os.environ["KUBECONFIG"] = str(BUILD / "kubeconfig")
            _create()
        _load()
        _make_namespace()
        TIMES["loaded"] = time.monotonic()
        request.config.stash[UP] = True
        yield
    finally:
        request.config.stash[UP] = False
        if not request.config.getoption("--keep", default=False):
            _remove(own)


def _remove(own: bool) -> None:
    if own:
        command("kind", "delete", "cluster", f"--name={CLUSTER}")
    else:
        words = ["delete", "namespace", *NAMESPACES, "--ignore-not-found", "--wait=false"]
        command("kubectl", *words)


def _create() -> None:
    if CLUSTER in command("kind", "get", "clusters").split():
        command("kind", "export", "kubeconfig", f"--name={CLUSTER}")
        return
    config = ROOT / "kind-config.yaml"
    command("kind", "create", "cluster", f"--name={CLUSTER}", "--config", config, timeout=300)


def _load() -> None:
    """Load the images where the cluster is one of kind; another has to be able to pull them."""
    context = command("kubectl", "config", "current-context").strip()
    if context.startswith("kind-"):
        name = f"CLUSTER={context.removeprefix('kind-')}"
        command("make", "kind-load", name, f"IMAGES={IMAGES}", timeout=300)


def _make_namespace() -> None:
    metadata = {"name": NAMESPACE, "labels": RESTRICTED}
    apply({"apiVersion": "v1", "kind": "Namespace", "metadata": metadata})


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report = yield
    if report.failed and item.config.stash.get(UP, False):
        folder = BUILD / re.sub(r"\W+", "-", item.name)
        try:
            save(folder)
        except (AssertionError, subprocess.SubprocessError, OSError) as error:
            SUMMARY.append(f"nothing more could be saved of {item.name}: {error}")
        SUMMARY.append(f"{item.name} FAILED: see {folder.relative_to(ROOT)}")
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if SUMMARY:
        terminalreporter.section("end to end")
        for line in SUMMARY:
            terminalreporter.write_line(line)


@pytest.fixture(scope="session")
def values(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the tests' release is installed with, over the chart's own values."""
    prometheus = {"kubernetes.io/metadata.name": f"{NAMESPACE}-monitoring"}
    given = {
        "link": {"mode": "relay"},
        "metrics": {"allowFrom": [{"namespaceSelector": {"matchLabels": prometheus}}]},
    }
    path = tmp_path_factory.mktemp("values") / "values.yaml"
    path.write_text(yaml.safe_dump(given))
    return path


@pytest.fixture(scope="session")
def installed(cluster: None, values: Path) -> None:
    """The release that most tests use."""
    from cloudrc.cluster.release import wait_ready

    kubectl("delete", "jobs", "--all")  # of an earlier session, where the cluster was kept
    began = time.monotonic()
    helm("upgrade", "--install", NAME, str(CHART), f"--values={values}")
    wait_ready(place(), timeout=120.0)
    SUMMARY.append(f"helm install until both pods are ready: {time.monotonic() - began:.0f} s")


@pytest.fixture(scope="session")
def prometheus_image(cluster: None) -> str:
    """A real Prometheus, and promtool with it."""
    found = command("docker", "images", "--format={{.Repository}}:{{.Tag}}", "cloudrc/prometheus")
    return found.split()[0]
