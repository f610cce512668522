"""The supervisor of a local run reads feeds and makes the key."""

from __future__ import annotations

import os
import selectors
import stat
import subprocess
import tempfile
from pathlib import Path
from typing import cast

import pytest

from cloudrc.drivers.feed import Feed, to_line
from cloudrc.drivers.local import Child, LocalRun, socket_folder
from cloudrc.drivers.machine import Deadline
from cloudrc.errors import BadInputError
from cloudrc.records import MissionEvent

EVENT = MissionEvent(5, "reached", 1, "waypoint 2 of 7 reached")


def test_a_bad_feed_line_is_reported_once_and_ends_no_flight(tmp_path: Path) -> None:
    reader, writer = os.pipe()
    run = LocalRun(tmp_path, lambda records: None)
    child = Child("cloud", cast("subprocess.Popen[bytes]", None), tmp_path / "cloud.log")
    run._selector.register(reader, selectors.EVENT_READ, child)
    event = to_line(EVENT).encode()
    os.write(
        writer, b"\n".join([b"ready", b"\xff", event, event + event, b"[" + event, event, b""])
    )
    fault, *told = run._listen()
    assert (told, child.ready, child.heard > 0.0) == ([EVENT, EVENT], True, True)
    assert "skipped a line of the cloud process" in str(fault)
    run._selector.close()
    os.close(reader)
    os.close(writer)


@pytest.mark.parametrize(
    ("tmpdir", "runtime", "chosen"),
    [("short", "", "short"), ("x" * 90, "run", "run"), ("x" * 90, "y" * 90, "/tmp")],
)
def test_sockets_lie_in_a_folder_with_a_short_path(
    tmpdir: str, runtime: str, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with tempfile.TemporaryDirectory(dir="/tmp", prefix="t") as root:
        places = {name: Path(root, name) for name in (tmpdir, runtime, chosen) if name}
        for place in places.values():
            place.mkdir(exist_ok=True)
        monkeypatch.setattr(tempfile, "tempdir", str(places[tmpdir]))
        monkeypatch.setenv("XDG_RUNTIME_DIR", str(places.get(runtime, "")))
        assert socket_folder() == str(Path(root, chosen))
        monkeypatch.setattr(os, "access", lambda *asked: False)
        with pytest.raises(BadInputError, match=r"^TMPDIR .* is too long for a socket"):
            socket_folder()


def test_a_deadline_does_not_count_the_time_in_which_we_stood_still() -> None:
    now = 0.0
    deadline = Deadline(3.0, turn_max=1.0, clock=lambda: now)
    for step, passed in ((0.9, False), (7.0, False), (0.9, False), (1.0, False), (0.9, True)):
        now += step
        assert deadline.passed() is passed
    assert deadline.pause == 7.0


def test_a_loop_gives_signs_of_life_to_a_supervisor_alone() -> None:
    for watched, lines in ((True, b"ready\n"), (False, b"")):
        reader, writer = os.pipe()
        os.set_blocking(reader, False)
        ask = Feed(writer, watched=watched).alive_while(lambda: True)
        assert ask()
        assert ask()
        os.close(writer)
        assert os.read(reader, 100) == lines
        os.close(reader)


def test_the_key_of_a_run_is_for_its_user_alone_and_goes_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[tuple[Path, int, int]] = []

    def look(run: LocalRun, *_: object) -> None:
        key = run._key
        seen.append((key, key.stat().st_mode, key.parent.stat().st_mode))

    monkeypatch.setattr(LocalRun, "_fly", look)
    before = os.umask(0)  # a user whose new files are open to all
    try:
        LocalRun(tmp_path, lambda records: None).fly(1.0)
    finally:
        os.umask(before)
    ((key, mode, folder),) = seen
    assert (stat.S_IMODE(mode), stat.S_IMODE(folder)) == (0o600, 0o700)
    assert not key.exists()
