"""`cloudrc link run` with netem, as in a pod: a process in a network namespace of its own."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from cloudrc.errors import MissingPrerequisiteError
from tests.link import conftest as lab

pytestmark = pytest.mark.netem
ROOT = Path(__file__).resolve().parents[2]
NEAR = 0.01
"""Of a median one-way delay, beside a process that needs the processor, too [s]."""
PATIENCE = 180.0
"""A slow virtual machine takes a minute to load Python while others need the processor [s]."""


@pytest.fixture(scope="module", autouse=True)
def _laboratory() -> Iterator[None]:
    try:
        with lab.laboratory():
            yield
    except lab.UnableError as error:
        pytest.exit(f"netem cannot be tested here: {error}", MissingPrerequisiteError.exit_code)


def until(condition: Callable[[], bool], patience: float = PATIENCE) -> float:
    began = time.monotonic()
    while not condition():
        assert time.monotonic() < began + patience, "never came true"
        time.sleep(0.02)
    return time.monotonic() - began


class Pod:
    """A link container in the near namespace."""

    def __init__(self, folder: Path, profile: str, mode: str, *prefix: str) -> None:
        self.route, self.state = folder / "route", folder / "link.json"
        self.profile, self.log = folder / "profile.yaml", folder / "log"
        self.profile.write_text(profile)
        command = [*prefix, sys.executable, "-m", "cloudrc", "link", "run", "--config", "paper"]
        command += ["--profile", str(self.profile), "--direction", "uplink", "--mode", mode]
        command += ["--peer", f"{lab.FAR_HOST}:7400", "--route", str(self.route)]
        with self.log.open("w") as log:
            words = ["ip", "netns", "exec", lab.NEAR, *command]
            self.process = subprocess.Popen(words, cwd=ROOT, stderr=log)

    def ready(self) -> dict[str, str]:
        until(lambda: self.route.exists() or self.process.poll() is not None)
        assert self.process.poll() is None, self.log.read_text()
        found: dict[str, str] = json.loads(self.state.read_text())
        return found

    def end(self) -> float:
        began = time.monotonic()
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(PATIENCE) == 0, self.log.read_text()
        return time.monotonic() - began


@pytest.fixture
def pod(tmp_path: Path) -> Iterator[Callable[..., Pod]]:
    pods: list[Pod] = []

    def make(profile: str, mode: str, *prefix: str) -> Pod:
        pods.append(Pod(tmp_path, profile, mode, *prefix))
        return pods[-1]

    yield make
    for one in pods:
        with suppress(ProcessLookupError):
            one.process.kill()
        one.process.wait()


def off(asked: float) -> float:
    """By how much the median one-way delay is off [s]; the least of up to three."""

    def error() -> float:
        return float(abs(np.median(lab.measure(50).delays()) - asked))

    return lab.least(error, NEAR)


@pytest.mark.smoke
def test_it_takes_netem_follows_the_profile_and_leaves_nothing(pod: Callable[..., Pod]) -> None:
    before = lab.qdiscs()
    link = pod("uplink: {delay_ms: 60}\n", "auto")
    state = link.ready()
    assert (state["shaper"], state["mode"], state["direction"]) == ("netem", "auto", "uplink")
    assert link.route.read_text() == f"{lab.FAR_HOST}:7400\n"
    assert off(0.060) < NEAR
    link.profile.write_text("uplink: {delay_ms: 120}\n")
    took = until(lambda: "delay 120ms" in lab.qdiscs())
    assert off(0.120) < NEAR
    until(lambda: json.loads(link.state.read_text())["changes"] > 0)
    state = json.loads(link.state.read_text())
    assert state["changes"] == 1, link.log.read_text()
    assert state["asked"]["delay"] == pytest.approx(0.120)
    ended = link.end()
    print("change took", round(took, 2), "end took", round(ended, 2))
    assert lab.qdiscs() == before
    assert not link.route.exists()


def test_a_qdisc_deleted_in_flight_is_an_error_in_the_log(pod: Callable[..., Pod]) -> None:
    link = pod("uplink: {delay_ms: 60}\n", "netem")
    link.ready()
    lab.sh("tc", "-n", lab.NEAR, "qdisc", "del", "dev", lab.DEVICE, "root")
    until(lambda: "error: the qdisc of wire was removed by another" in link.log.read_text())
    assert "netem" not in lab.qdiscs(), "it is not repaired"
    link.end()


def test_without_the_capability_auto_uses_relay_and_netem_fails(
    pod: Callable[..., Pod],
) -> None:
    drop = ("setpriv", "--bounding-set", "-net_admin", "--inh-caps", "-net_admin")
    link = pod("uplink: {delay_ms: 60}\n", "auto", *drop)
    state = link.ready()
    assert (state["shaper"], state["reason"]) == (
        "relay",
        "netem does not work here: no uid 0 with NET_ADMIN",
    )
    link.end()
    strict = pod("uplink: {delay_ms: 60}\n", "netem", *drop)
    assert strict.process.wait(PATIENCE) == MissingPrerequisiteError.exit_code
    assert "no uid 0 with NET_ADMIN" in strict.log.read_text()
