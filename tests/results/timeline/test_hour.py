# SPDX-License-Identifier: Apache-2.0

"""The recording of an hour, 360,000 commands, becomes a budget in a minute and in 400 MB."""

import json
import subprocess
import sys

import pytest

from cloudrc.results.record.writer import McapWriter
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.wire.records import (
    Arrival,
    CommandApplied,
    GroundTruth,
    GuardChange,
    MissionEvent,
    TelemetrySent,
)
from tests.doors.console.conftest import control

MS = 1_000_000
COMMANDS = 360_000
MEASURE = """
import json, resource, sys, time
from cloudrc.doors.cli.main import main
import cloudrc.results.timeline.read, cloudrc.results.timeline.trace, cloudrc.results.record.reader
def used():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
before, began = used(), time.process_time()
main(["timeline", sys.argv[1], "-o", "json"])
print(json.dumps({"took": time.process_time() - began, "more": used() - before}), file=sys.stderr)
"""


def records_of(n):
    """Return what both ends record in a period of 10 ms: 30 ms up and 20 ms down."""
    now = (n + 100) * 10 * MS
    odometry = Odometry(now, (0.0, 0.0, 1.0), UPRIGHT, ZERO, ZERO)
    telemetry = Telemetry(now, odometry, (), now - 70 * MS, 0, 0, 1, GuardState.TRACK)
    basis = now - 40 * MS
    made = control(now / 1e9, epoch=2, counter=n)._replace(stamp_ns=now, basis_stamp_ns=basis)
    return [
        TelemetrySent(now, 2, n, telemetry),
        GroundTruth(now, odometry, ZERO),
        Arrival(now, True, 2, n - 3, 0.03, True),
        Arrival(now, False, 2, n - 2, 0.02, True),
        CommandApplied(now, 2, n - 2, basis - 20 * MS, ZERO),
        made,
    ]


@pytest.mark.full
@pytest.mark.alone
def test_an_hour_takes_at_most_a_minute_and_400_mb(tmp_path):
    path = tmp_path / "mission.mcap"
    with McapWriter(path, clock="world", clock_id="one") as writer:
        writer.write([GuardChange(500 * MS, GuardState.TRACK, "test")])
        for n in range(COMMANDS):
            writer.write(records_of(n))
        writer.write([MissionEvent((COMMANDS + 100) * 10 * MS, "done", 0, "test")])
    asked = [sys.executable, "-c", MEASURE, str(path)]
    done = subprocess.run(asked, capture_output=True, text=True, check=True)
    budget = json.loads(done.stdout)["budgets"]["loop"]
    assert budget["commands"] > COMMANDS - 10
    means = {name: each["mean"] for name, each in budget["stages"].items()}
    expected = {"observation": 0, "uplink": 0.03, "queue": 0.01, "downlink": 0.02, "wait": 0}
    assert means == pytest.approx(expected, abs=1e-9)
    measured = json.loads(done.stderr.splitlines()[-1])
    print(measured)
    assert measured["took"] <= 60
    assert measured["more"] < 400e6
