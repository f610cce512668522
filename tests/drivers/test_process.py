"""A process of a run ends when its supervisor is gone."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from cloudrc.drivers.process import PARENT, StopSignal

KILLED_AT_ONCE = """
import os, signal, sys
from pathlib import Path
from cloudrc.drivers.local import LocalRun, _free_addresses

run, ways = LocalRun(Path(sys.argv[1]), print), ("world-side", "cloud-side", "world", "cloud")
run._start("relay", *map("--{}={}".format, ways, _free_addresses(4)))
print(run._children[0].process.pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
CONFIG = Path(__file__).parents[2] / "cloudrc" / "experiments" / "hover.yaml"


@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize(
    ("told", "ends"),
    [(None, False), (str(os.getppid()), False), (str(os.getpid()), True), ("nobody", False)],
    ids=["untold", "parent", "stranger", "nonsense"],  # process ids differ each time
)
def test_it_ends_if_it_is_not_the_child_of_who_has_started_it(
    told: str | None, ends: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(PARENT, raising=False)
    if told is not None:
        monkeypatch.setenv(PARENT, told)
    assert StopSignal()() is ends
    assert PARENT not in os.environ  # children must not inherit it


@pytest.mark.process
def test_it_ends_if_its_supervisor_was_killed_before_its_start(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(CONFIG.read_text())
    command = [sys.executable, "-c", KILLED_AT_ONCE, str(tmp_path)]
    supervisor = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert supervisor.returncode == -signal.SIGKILL, supervisor.stderr
    try:
        orphan = os.pidfd_open(int(supervisor.stdout))
    except ProcessLookupError:
        return  # it has already ended
    ended, _, _ = select.select([orphan], [], [], 30.0)
    if not ended:
        signal.pidfd_send_signal(orphan, signal.SIGKILL)
    os.close(orphan)
    assert ended
    assert (tmp_path / "relay.log").read_text().startswith("cloudrc relay: ")  # as after a signal
