"""The costs of the closed loop and of sealed datagrams."""

import json
import subprocess
import sys
import timeit

import pytest

from cloudrc.messages import GuardState, Odometry, Telemetry
from cloudrc.tunnel import codec
from cloudrc.tunnel.session import pair


@pytest.mark.process
def test_a_sealed_odometry_costs_microseconds(figure):
    odometry = Odometry(1, (0.1, 0.2, 0.3), (0.9, 0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.7, 0.8, 0.9))
    telemetry = Telemetry(1, odometry, 0.0, 2, 3, 0, 1, GuardState.TRACK)
    sender, receiver = pair()

    def seal_and_open():
        datagram = sender.seal(int(codec.Kind.TELEMETRY), codec.encode_telemetry(telemetry))
        codec.decode_telemetry(receiver.open(datagram)[-1])

    cost = min(timeit.repeat(seal_and_open, number=400, repeat=60)) / 400
    figure("encode, seal, open and decode an odometry", cost, "<=", 20e-6, "s")


@pytest.mark.process  # runs alone: other processes would take its caches
@pytest.mark.full
def test_the_closed_loop_is_fast_enough_beside_raw_physics():
    command = [sys.executable, "-m", "cloudrc", "bench", "-o", "json", "--repeats", "5"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["closed loop, records in memory"]["ratio"] >= 0.30
    assert figures["closed loop, records hashed"]["ratio"] >= 0.25
