"""The script that `link set` runs in a link container, with a real `sh`."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from pathlib import Path

import pytest

from cloudrc.cluster.link import APPLY_LIMIT, APPLY_SCRIPT
from cloudrc.link.follow import HANDED_FILE, Handed, read_handed, write_handed
from cloudrc.link.state import STATE_FILE, LinkState, publish, to_text

NOTE = json.dumps({"number": "b2", "cause": "zwölf", "restart": False})
TRACE = "time_s,delay_ms\n" + "0,40\n" * 20_000
DOCUMENT = write_handed(Handed(NOTE, {"profile.yaml": "uplink: {trace: t.csv}\n", "t": TRACE}))


def start(folder: Path, length: int = len(DOCUMENT.encode())) -> subprocess.Popen[str]:
    command = ["sh", "-c", APPLY_SCRIPT, "sh", str(folder), "b2", str(length)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)


def tell(folder: Path, **state: str) -> str:
    text = to_text(LinkState("relay", "", "relay", "uplink", {}, "", 1, **state))
    publish(folder / STATE_FILE, text)
    return text


@pytest.mark.parametrize("state", [{"change": "b2"}, {"change": "a1", "refused": "b2"}])
def test_the_script_hands_over_a_change_and_prints_the_state(
    tmp_path: Path, state: dict[str, str]
) -> None:
    tell(tmp_path, change="a1", refused="b22")
    running = start(tmp_path)
    decided = list[str]()

    def sidecar() -> None:
        while not (tmp_path / HANDED_FILE).exists():
            time.sleep(0.005)
        decided.append(tell(tmp_path, **state))

    thread = threading.Thread(target=sidecar)
    thread.start()
    out, err = running.communicate(DOCUMENT, timeout=2 * APPLY_LIMIT)
    thread.join()
    assert (running.returncode, out, err) == (0, decided[0], "")
    assert read_handed((tmp_path / HANDED_FILE).read_text()).change == NOTE
    assert sorted(os.listdir(tmp_path)) == [HANDED_FILE, STATE_FILE], "no draft is left"


@pytest.mark.process
def test_a_silent_sidecar_leaves_the_old_state(tmp_path: Path) -> None:
    told = tell(tmp_path, change="a1")
    out, _ = start(tmp_path).communicate(DOCUMENT, timeout=10 * APPLY_LIMIT)
    assert out == told


def test_an_incomplete_change_is_not_handed_over(tmp_path: Path) -> None:
    tell(tmp_path, change="a1")
    running = start(tmp_path)
    _, err = running.communicate(DOCUMENT[:-1])
    assert (running.returncode, err) == (2, "error: the change arrived incomplete;\n")
    assert os.listdir(tmp_path) == [STATE_FILE]


@pytest.mark.parametrize("folder", [".", "none"])
def test_a_container_without_a_link_is_refused(tmp_path: Path, folder: str) -> None:
    running = start(tmp_path / folder)
    _, err = running.communicate("")
    assert (running.returncode, err) == (2, "error: no link runs here;\n")
    assert os.listdir(tmp_path) == []
