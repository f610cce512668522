# SPDX-License-Identifier: Apache-2.0

"""The cluster and the release of the end-to-end tests; helpers that read and command them."""

import json
import os
import re
import shutil
import subprocess
import time
from functools import cache
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from cloudrc.base.errors import CloudrcError
from cloudrc.cluster.client import connect
from cloudrc.cluster.flight import wait_ready
from cloudrc.cluster.jobs import follow, run_job
from cloudrc.cluster.pods import METRICS, fetch_recording, forwarded
from cloudrc.config.load import load_experiment
from cloudrc.flight.links.verify import fetch
from tests.flight.conftest import WORK, slower
from tests.support.commands import python

ROOT = Path(__file__).resolve().parents[2]
CHART = ROOT / "charts" / "cloudrc"
EXAMPLES = CHART / "examples"
NAMESPACE = "cloudrc-e2e"
MONITORING = f"{NAMESPACE}-monitoring"
NAMESPACES = (NAMESPACE, MONITORING)
"""Namespaces that these tests create."""
NAME = "cloudrc"
ENDS = ("world", "cloud")
RESTRICTED = f"""
apiVersion: v1
kind: Namespace
metadata: {{name: {NAMESPACE}, labels: {{pod-security.kubernetes.io/enforce: restricted}}}}
"""
SUMMARY = []
"""Lines that pytest prints after the tests."""
TIMES = {}
"""Event of the test session -> its time on the monotonic clock [s]."""


def command(*words, given="", timeout=120.0):
    """Run a command and return its output; raise an error if its exit code is not 0."""
    done = subprocess.run(
        [str(word) for word in words],
        input=given,
        capture_output=True,
        text=True,
        timeout=timeout,
        cwd=ROOT,
    )
    if done.returncode != 0:
        line = " ".join(map(str, words))
        raise AssertionError(f"{line}: exit code {done.returncode}\n{done.stdout}{done.stderr}")
    return done.stdout


def kubectl(*words, given="", timeout=120.0):
    """Run kubectl in the namespace of the tests, unless `words` name another; return its output."""
    return command("kubectl", f"--namespace={NAMESPACE}", *words, given=given, timeout=timeout)


def read(*words):
    """Return the result of `kubectl get`, parsed."""
    return json.loads(kubectl("get", *words, "--output=json"))


def apply(objects, namespace=NAMESPACE):
    """Apply objects, a text in YAML."""
    kubectl(f"--namespace={namespace}", "apply", "--filename=-", given=objects)


def helm(*words, timeout=180.0):
    return command("helm", f"--namespace={NAMESPACE}", *words, timeout=timeout)


def cloudrc(*words, timeout=240.0):
    """Run cloudrc; any exit code is accepted."""
    return python("-m", "cloudrc", *words, timeout=timeout, cwd=ROOT)


def in_release(*words, release=NAME):
    """Run cloudrc for a release, and return its output."""
    done = cloudrc(*words, "-n", NAMESPACE, "--release", release)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def report(folder, release, *mission):
    """Run `cloudrc mission report`; return the report."""
    line = ["mission", "report", release, *mission, "-n", NAMESPACE, "--out", folder, "-o", "json"]
    done = cloudrc(*map(str, line))
    assert done.returncode == 0, done.stdout + done.stderr
    assert (folder / "report.html").is_file()
    return json.loads(done.stdout)


def set_link(*words):
    """Run `cloudrc link set` for the release; return its report of the new link."""
    return dict(json.loads(in_release("link", "set", *words, "-o", "json")))


def eventually(look, what, timeout=30.0, every=0.5):
    """Call `look` until its result is true, and return that; fail after `timeout` [s]."""
    until = time.monotonic() + timeout
    while True:
        seen = look()
        if seen:
            return seen
        assert time.monotonic() < until, f"not within {timeout:g} s: {what}"
        time.sleep(every)


def place(release=NAME):
    return connect(None, NAMESPACE, release)


def until_ready(release=NAME):
    wait_ready(place(release), timeout=120.0)


def pods(component):
    selector = f"app.kubernetes.io/instance={NAME},app.kubernetes.io/component={component}"
    return read("pods", f"--selector={selector}")["items"]


def pod(component):
    """Return the component's only pod that is not being deleted."""
    (found,) = [p for p in pods(component) if "deletionTimestamp" not in p["metadata"]]
    return found


def identity():
    """Return UID and restart counts, which change if a pod is replaced or a container restarts."""
    found = {}
    for component in ENDS:
        one = pod(component)
        status = one["status"]
        containers = [*status.get("initContainerStatuses", []), *status["containerStatuses"]]
        found[component] = one["metadata"]["uid"], [c["restartCount"] for c in containers]
    return found


def scrapes(component):
    """Return the page /metrics of each container of a pod."""
    name, ports = pod(component)["metadata"]["name"], METRICS[component]
    with forwarded(place(), name, list(ports.values())) as local:
        urls = {each: f"http://127.0.0.1:{local[port]}/metrics" for each, port in ports.items()}
        return {container: fetch(url) for container, url in urls.items()}


def samples(text):
    """Parse a page of metrics: name and sorted labels -> value."""
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def metrics(component):
    """Return the samples of the container world or cloud."""
    return samples(scrapes(component)[component])


def value(samples, name, **labels):
    """Add up the samples of a name whose labels include the given ones."""
    found = [
        number
        for (each, given), number in samples.items()
        if each == name and labels.items() <= dict(given).items()
    ]
    assert found, f"no sample {name} {labels}"
    return sum(found)


DIRECTIONS = {"uplink": "cloud", "downlink": "world"}
"""Direction -> end that measures its delay."""


def _delays():
    """Return per direction the sum [s] and the number of the one-way delays measured so far."""
    found = {}
    for direction, end in DIRECTIONS.items():
        samples, name = metrics(end), f"cloudrc_{direction}_delay_seconds"
        found[direction] = value(samples, f"{name}_sum"), value(samples, f"{name}_count")
    return found


def mean_delays(seconds):
    """Return per direction the mean delay [s] and the number of datagrams of the next seconds."""
    before, found = _delays(), {}
    time.sleep(seconds)
    for direction, (total, count) in _delays().items():
        new = count - before[direction][1]
        found[direction] = (total - before[direction][0]) / new, new
    return found


def job_end(name, release=NAME):
    """Wait for the end of a Job; check that its state fits its end; return its end and its log."""
    lines = []
    end = follow(place(release), name, lines.append)
    assert read("job", name)["status"].get("succeeded", 0) == (end.exit_code == 0), end
    return end, "\n".join(lines)


def job_log(name):
    """Return the log of a Job so far; "" while its pod is pending."""
    pods = read("pod", f"--selector=batch.kubernetes.io/job-name={name}")["items"]
    runs = [each for each in pods if each["status"]["phase"] != "Pending"]
    return kubectl("logs", runs[0]["metadata"]["name"]) if runs else ""


def fly(name, waypoints, limit=60.0, release=NAME, **keys):
    """Start a Job that flies waypoints, as `cloudrc mission run` does; `keys` of the mission."""
    mission = {"name": name, "time_limit_s": limit, "waypoints": list(waypoints), **keys}
    run_job(place(release), mission, name=name)


PIPES = load_experiment("paper").mission.model_dump(mode="json", include={"waypoints", "touch"})
"""The paper's mission."""
INTERRUPTED = 130
"""Exit code of a mission that was cancelled."""
LONG = [
    {"position_m": [0.5, 0.0, 0.7]},
    {"position_m": [0.5, 1.0, 0.7], "dwell_s": 200.0, "time_limit_s": 300.0},
]
"""Waypoints of a mission that waits at the second one for longer than any test takes."""


def save(folder):
    """Save objects, events, logs and recordings after a failure."""
    names = f"--namespaces={','.join(NAMESPACES)}"
    command("kubectl", "cluster-info", "dump", names, f"--output-directory={folder}")
    for component in ENDS:
        fetch_recording(place(), component, folder / f"{component}.mcap")


CLUSTER = "cloudrc-e2e"
IMAGES = "world world-camera cloud prometheus"  # a real Prometheus is for these tests alone
BUILD = ROOT / "build" / "e2e"
TOOLS = ("docker", "kind", "helm", "kubectl")
MISSING_PREREQUISITE = 3
UP = pytest.StashKey[bool]()
LOAD_MAX = 1.5
"""Load per core above which real time cannot be judged [1].

The loop's periods and the link's packets then wait for a core: delays grow by milliseconds.
"""
IDLE_MIN = 0.15
"""Share of the cores' time without work during a test below which real time cannot be judged [1].
The load, a mean of a minute, rises too late for a short test."""
TOO_BUSY = "the machine is too busy to judge real time"
STAT = Path("/proc/stat")
"""Linux' count of how the cores have spent their time; other systems have none."""
STARTED = pytest.StashKey[tuple[int, int]]()
"""Test -> the cores' time when it started."""


def cores_time():
    """Return the time of all cores since the machine started: idle, and in total [ticks]."""
    if not STAT.exists():
        return 0, 0
    ticks = [int(word) for word in STAT.read_text("utf-8").split("\n", 1)[0].split()[1:]]
    return ticks[3], sum(ticks[:8])


def busy(started):
    """Say how busy this machine was since `started`; "" if real time can be judged."""
    load, cores = os.getloadavg()[0], os.cpu_count()
    idle, total = (now - then for now, then in zip(cores_time(), started, strict=True))
    share = idle / total if total else 1.0
    told = f"{TOO_BUSY}: load {load:.1f} on {cores} cores, idle for {share:.0%} of the test"
    return told if load > LOAD_MAX * cores or share < IDLE_MIN else ""


def pytest_addoption(parser):
    parser.addoption("--keep", action="store_true", help="leave the kind cluster for a look")


def pytest_collection_modifyitems(items):
    for item in items:
        if Path(__file__).parent in item.path.parents:
            item.add_marker(pytest.mark.e2e)


@pytest.fixture(scope="session")
def note():
    """A function that adds a line to the summary."""
    return SUMMARY.append


@pytest.fixture(scope="session")
def cluster(request):
    """A cluster with the images: the one of KUBECONFIG, or else a new kind cluster."""
    own = "KUBECONFIG" not in os.environ
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        pytest.exit(f"e2e needs {', '.join(missing)}, not installed", MISSING_PREREQUISITE)
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
        load(IMAGES)
        apply(RESTRICTED)
        request.config.stash[UP] = True
        yield
    finally:
        request.config.stash[UP] = False
        if not request.config.getoption("--keep", default=False):
            if own:
                command("kind", "delete", "cluster", f"--name={CLUSTER}")
            else:
                words = ["namespace", *NAMESPACES, "--ignore-not-found", "--wait=false"]
                command("kubectl", "delete", *words)


def _create():
    if CLUSTER in command("kind", "get", "clusters").split():
        command("kind", "export", "kubeconfig", f"--name={CLUSTER}")
        return
    config = ROOT / "kind-config.yaml"
    command("kind", "create", "cluster", f"--name={CLUSTER}", "--config", config, timeout=300)


def load(images):
    """Load images into a kind cluster; any other cluster must be able to pull them."""
    context = command("kubectl", "config", "current-context").strip()
    if context.startswith("kind-"):
        name = f"CLUSTER={context.removeprefix('kind-')}"
        command("make", "kind-load", name, f"IMAGES={images}", timeout=300)


def pytest_runtest_setup(item):
    item.stash[STARTED] = cores_time()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Skip what failed on a machine that is too busy: it says nothing about real time.

    So it is in CI, too: .ci/run counts these tests in its last lines.
    """
    report = yield
    judges = item.get_closest_marker("real_time") and STARTED in item.stash
    if report.failed and judges and (why := busy(item.stash[STARTED])):
        SUMMARY.append(f"{item.name}: {call.excinfo.exconly().splitlines()[0]}; {why}")
        report.outcome = "skipped"
        report.longrepr = (str(item.path), item.location[1] or 0, f"Skipped: {TOO_BUSY}")
    if report.failed and item.config.stash.get(UP, False):
        folder = BUILD / re.sub(r"\W+", "-", item.name)
        try:
            save(folder)
        except (AssertionError, CloudrcError, subprocess.SubprocessError, OSError) as error:
            SUMMARY.append(f"nothing more could be saved of {item.name}: {error}")
        SUMMARY.append(f"{item.name} FAILED: see {folder.relative_to(ROOT)}")
    return report


def pytest_terminal_summary(terminalreporter):
    if SUMMARY:
        terminalreporter.section("end to end")
        for line in SUMMARY:
            terminalreporter.write_line(line)


VALUES = f"""
link: {{mode: relay}}
dashboards: {{enabled: true}}
metrics:
  allowFrom:
  - namespaceSelector: {{matchLabels: {{kubernetes.io/metadata.name: {MONITORING}}}}}
"""


@pytest.fixture(scope="session")
def values(tmp_path_factory):
    """The file of values with which the tests install their release."""
    path = tmp_path_factory.mktemp("values") / "values.yaml"
    path.write_text(VALUES)
    return path


@pytest.fixture(scope="session")
def installed(cluster, values):
    """The release that most tests use."""
    kubectl("delete", "jobs", "--all")  # of an earlier session, where the cluster was kept
    began = time.monotonic()
    helm("upgrade", "--install", NAME, str(CHART), f"--values={values}")
    until_ready()
    SUMMARY.append(f"helm install until both pods are ready: {time.monotonic() - began:.0f} s")


@pytest.fixture(scope="session")
def prometheus(installed):
    """A Prometheus that scrapes the release from now on."""
    from tests.e2e.neighbours import install_prometheus

    install_prometheus()


def processor_times():
    """Return the monotonic time [s], and the CPU time of each process of the release [s]."""
    texts = {f"{end}/{name}": text for end in ENDS for name, text in scrapes(end).items()}
    name = "process_cpu_seconds_total"
    return time.monotonic(), {each: value(samples(t), name) for each, t in texts.items()}


def memory():
    """Return the memory of all containers of the release, as the kubelet counts it [bytes]."""
    node = pod("world")["spec"]["nodeName"]
    summary = command("kubectl", "get", "--raw", f"/api/v1/nodes/{node}/proxy/stats/summary")
    found = {each["podRef"]["uid"]: each["containers"] for each in json.loads(summary)["pods"]}
    mine = [found[pod(end)["metadata"]["uid"]] for end in ENDS]
    return sum(each["memory"]["workingSetBytes"] for containers in mine for each in containers)


@cache  # measured once, because later a test may have just replaced the pod
def pace():
    """Return how much slower than nominal Python is in the world container [1]; at least 1."""
    words = ("exec", pod("world")["metadata"]["name"], "--container=world", "--")
    return slower(kubectl(*words, "python", "-c", WORK))
