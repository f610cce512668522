"""How the cluster's scenarios kill cloud, and that they judge how long it takes to be back."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import pytest

from cloudrc.cluster.tools import ClusterError
from cloudrc.faults.cluster import pods
from cloudrc.faults.cluster.pods import KILL
from cloudrc.faults.scenario import find
from cloudrc.messages import GuardState
from cloudrc.record.columns import Recording
from cloudrc.records import GuardChange

FIRST = f"""
import os, signal, subprocess, sys, time
while time.process_time() < 1.1: pass
os.kill(os.getpid(), signal.SIGKILL)
print("unhurt", flush=True)
subprocess.run([sys.executable, "-c", {KILL!r}])
end = time.monotonic() + 20
while time.monotonic() < end: pass
print("alive")
"""
"""Of a namespace like a container's: whom no process within can send a SIGKILL."""


@pytest.mark.process
def test_the_first_process_of_a_container_is_killed_from_within() -> None:
    command = ["unshare", "--user", "--map-root-user", "--pid", "--fork", "--kill-child"]
    if subprocess.run([*command, "true"], capture_output=True, check=False).returncode:
        pytest.skip("no namespaces can be made here; run as root")
    words = [*command, sys.executable, "-c", FIRST]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout == "unhurt\n"
    assert done.returncode != 0


def test_that_the_kill_takes_its_messenger_with_it_is_no_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said: list[str] = []

    def kubectl(release: object, *words: str) -> str:
        said.extend(words)
        raise ClusterError("'kubectl exec' failed: command terminated with exit code 137")

    pod = SimpleNamespace(metadata=SimpleNamespace(name="cloud-1"))
    monkeypatch.setattr(pods, "find_pod", lambda release, component: pod)
    monkeypatch.setattr(pods, "kubectl", kubectl)
    pods._kill_container(SimpleNamespace())  # type: ignore[arg-type]
    assert said == ["exec", "cloud-1", "--container=cloud", "--", "python", "-c", KILL]


def flown(*causes: str) -> Recording:
    changes = [GuardChange(n, GuardState.HOLD, cause) for n, cause in enumerate(causes)]
    return Recording.from_records(changes, [])


WANT, WORD = "command age 0.252 s above 0.250 s", "mission ended"


@pytest.mark.parametrize(
    ("fault", "waited", "after", "missed"),
    [
        ("F13", 3.0, [WANT, WORD], []),
        ("F13", 3.0, [WORD], ["container: HOLDs for want", "pod: HOLDs for want"]),
        ("F13", 3.0, [WORD, WORD], ["container: HOLDs for want"]),
        ("F13", 3.6, [WANT, WORD], ["container: flown again"]),
        ("F13", 6.1, [WANT, WORD], ["container: flown again", "pod: flown again"]),
        ("F14", 1.9, [WORD, WORD], []),
        ("F14", 1.9, [WANT, WORD], ["HOLDs by teleop's word"]),
        ("F14", 2.1, [WORD, WORD], ["HOLD after"]),
        ("F14", 7.1, [WORD, WORD], ["HOLD after", "flown again after"]),
    ],
)
def test_who_is_late_or_holds_for_another_cause_has_failed(
    fault: str, waited: float, after: list[str], missed: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Everything takes `waited` [s]; `after` are the causes of the HOLDs of such a mission."""
    there: dict[str, Any] = {
        "release_there": SimpleNamespace,
        "recording": lambda release, name: flown(),
        "flying": lambda release, number: "job",
        "reading": lambda release, component, name: 1.0,
        "delete": lambda *words: None,
        "_kill_container": lambda release: None,
        "until": lambda text, condition: waited,
        "finish": lambda outcome, release, name: flown(*after),
    }
    for name, stand_in in there.items():
        monkeypatch.setattr(pods, name, stand_in)
    failed = [each.text for each in find(fault, "cluster").run(1).checks if not each.passed]
    assert len(failed) == len(missed)
    assert all(text.startswith(word) for text, word in zip(failed, missed, strict=True))
