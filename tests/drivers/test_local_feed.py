"""The supervisor of a local run reads feeds and makes the key."""

from __future__ import annotations

import os
import selectors
import stat
import subprocess
from pathlib import Path
from typing import cast

import pytest

from cloudrc.drivers.feed import to_line
from cloudrc.drivers.local import Child, LocalRun
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
    assert (told, child.ready, child.heard is not None) == ([EVENT, EVENT], True, True)
    assert "skipped a line of the cloud process" in str(fault)
    run._selector.close()
    os.close(reader)
    os.close(writer)


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
