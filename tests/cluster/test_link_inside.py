"""What `link set` runs in a link container, by a real `sh`: a document in, the state out."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import time
from pathlib import Path

import pytest

from cloudrc.cluster.link import INSIDE, PATIENCE
from cloudrc.link.follow import HANDED_FILE, Handed, read_handed, write_handed
from cloudrc.link.state import STATE_FILE, LinkState, publish, to_text

NOTE = json.dumps({"number": "b2", "cause": "zwölf", "restart": False})
TRACE = "time_s,delay_ms\n" + "0,40\n" * 20_000
DOCUMENT = write_handed(Handed(NOTE, "", {"profile.yaml": "uplink: {trace: t.csv}\n", "t": TRACE}))


def start(folder: Path, length: int = len(DOCUMENT.encode())) -> subprocess.Popen[str]:
    command = ["sh", "-c", INSIDE, "sh", str(folder), "b2", str(length)]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)


def tell(folder: Path, **state: str) -> str:
    text = to_text(LinkState("relay", "", "relay", "uplink", {}, "", 1, **state))
    publish(folder / STATE_FILE, text)
    return text


@pytest.mark.parametrize("state", [{"change": "b2"}, {"change": "a1", "refused": "b2"}])
def test_a_change_is_handed_over_and_the_answer_is_printed(
    tmp_path: Path, state: dict[str, str]
) -> None:
    tell(tmp_path, change="a1", refused="b2-back")
    running = start(tmp_path)
    decided = list[str]()

    def sidecar() -> None:
        while not (tmp_path / HANDED_FILE).exists():
            time.sleep(0.005)
        decided.append(tell(tmp_path, **state))

    thread = threading.Thread(target=sidecar)
    thread.start()
    out, err = running.communicate(DOCUMENT, timeout=2 * PATIENCE)
    thread.join()
    assert (running.returncode, out, err) == (0, decided[0], "")
    assert read_handed((tmp_path / HANDED_FILE).read_text()).change == NOTE
    assert sorted(os.listdir(tmp_path)) == [HANDED_FILE, STATE_FILE], "no draft is left"


@pytest.mark.process
def test_a_link_that_does_not_follow_is_told_as_it_is(tmp_path: Path) -> None:
    told = tell(tmp_path, change="a1")
    out, _ = start(tmp_path).communicate(DOCUMENT, timeout=10 * PATIENCE)
    assert out == told


def test_what_was_cut_off_on_its_way_is_not_handed_over(tmp_path: Path) -> None:
    tell(tmp_path, change="a1")
    running = start(tmp_path)
    _, err = running.communicate(DOCUMENT[:-1])
    assert (running.returncode, err) == (2, "error: the change did not arrive whole;\n")
    assert os.listdir(tmp_path) == [STATE_FILE]


@pytest.mark.parametrize("folder", [".", "none"])
def test_nothing_happens_where_no_link_is(tmp_path: Path, folder: str) -> None:
    running = start(tmp_path / folder)
    _, err = running.communicate("")
    assert (running.returncode, err) == (2, "error: no link is shaped here;\n")
    assert os.listdir(tmp_path) == []
