"""What the supervisor of a local run makes of the lines that its processes write."""

from __future__ import annotations

import os
import selectors
import subprocess
from pathlib import Path
from typing import cast

from cloudrc.drivers.feed import to_line
from cloudrc.drivers.local import Child, LocalRun
from cloudrc.records import MissionEvent

EVENT = MissionEvent(5, "reached", 1, "waypoint 2 of 7 reached")


def test_a_line_that_is_no_record_is_said_once_and_ends_no_flight(tmp_path: Path) -> None:
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
    assert "of the cloud process a line was left out" in str(fault)
    run._selector.close()
    os.close(reader)
    os.close(writer)
