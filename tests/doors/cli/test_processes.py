# SPDX-License-Identifier: Apache-2.0

"""World and cloud as commands: flags, addresses, recordings, sizes, stopping at start."""

import argparse
import os
import signal
import socket
from unittest.mock import Mock

import pytest

from cloudrc.base.errors import ControllerLostError
from cloudrc.doors.cli.parser import read_size
from cloudrc.doors.cli.processes import read_address
from cloudrc.flight.assembly.cloud import build_cloud
from cloudrc.flight.pod import ends, realtime
from cloudrc.flight.pod.realtime import free_ports, show_address
from cloudrc.results.record.columns import Recording
from tests.results.record.conftest import MS, counted, world_records

ENDS = ("world", "cloud")


@pytest.fixture
def key(tmp_path):
    (tmp_path / "key").write_bytes(b"k" * 32)
    (tmp_path / "key").chmod(0o600)
    return f"--key {tmp_path / 'key'}"


def test_an_address_of_ipv6_is_in_brackets(monkeypatch):
    for text in ("127.0.0.1:7400", "[::1]:7400", "[::]:1"):
        assert show_address(read_address(text)) == text
    with pytest.raises(argparse.ArgumentTypeError, match=r"such as .* \[::1\]:7400"):
        read_address("::1:7400")
    with pytest.raises(argparse.ArgumentTypeError, match="label"):
        read_address("a..b:5")
    monkeypatch.setattr(socket, "socket", Mock(side_effect=OSError("Address family")))
    assert read_address("[::]:7400") == ("0.0.0.0", 7400), "on a machine without IPv6"


# Here, too, the socket stays open after the command.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.child
@pytest.mark.parametrize("end", ENDS)
def test_an_end_stopped_at_its_start_completes_its_recording(end, key, tmp_path, monkeypatch, call):
    """The handlers are set first: as the first process of a container, an end needs them."""
    build = getattr(ends, f"build_{end}")

    def stop_and_build(*arguments, **named):
        os.kill(os.getpid(), signal.SIGTERM)
        return build(*arguments, **named)

    monkeypatch.setattr(ends, f"build_{end}", stop_and_build)
    (tmp_path / "key").chmod(0o644)
    flags = f"--listen 127.0.0.1:{free_ports(1)[0]} --route route {key} --record end.mcap"
    flags += " --teleop teleop" if end == "cloud" else ""
    errors = call(f"process {end} --config hover {flags}").err
    assert (tmp_path / "end.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")
    assert f"warning: {tmp_path / 'key'} can be read by others: chmod 600" in errors


@pytest.mark.child
def test_cloud_without_a_supervisor_ends_if_its_controller_is_lost(key, monkeypatch, refused):
    """In a pod, Kubernetes starts it again: the next mission gets a new controller."""
    build, bound = build_cloud, []

    def bind(address):
        bound.append(realtime.bind(address))
        return bound[-1]

    def build_lost(*arguments, **named):
        cloud = build(*arguments, **named)
        cloud._loop.lost = ControllerLostError("controller_silent", "no node answers")
        os.kill(os.getpid(), signal.SIGTERM)  # also ends a cloud that would go on
        return cloud

    monkeypatch.setattr(ends, "bind", bind)
    monkeypatch.setattr(ends, "build_cloud", build_lost)
    flags = f"--listen 127.0.0.1:{free_ports(1)[0]} --route route {key} --record end.mcap"
    line = refused(f"process cloud --config hover {flags} --teleop teleop", code=5)
    assert line == "cloudrc: error: no node answers\n"
    bound[0].close()  # as at the end of the process


def test_sizes_are_read_as_in_kubernetes():
    sizes = {"1Gi": 2**30, "500M": 5e8, "1.5Ki": 1536, "4096": 4096, "1k": 1e3}
    assert {text: read_size(text) for text in sizes} == sizes
    with pytest.raises(argparse.ArgumentTypeError, match="such as 500M or 1Gi"):
        read_size("1GB")


def started(path, size_max=None):
    return ends.open_recorder(path, size_max, "world", b"id", {})


def write_down(recorder, records):
    recorder.put(records)
    while recorder._drain():
        pass
    recorder._flush()


def test_both_recordings_together_stay_within_the_limit(tmp_path):
    for _ in range(2):
        recorder = started(tmp_path / "world.mcap", 200_000)
        for start in range(0, 30_000, 500):
            write_down(recorder, world_records(50, start * MS))
            sizes = [each.stat().st_size for each in tmp_path.iterdir()]
            assert sum(sizes) < 220_000, "each ends with its open chunk"
        recorder._close()
        assert recorder.error == ""


def test_a_restart_keeps_the_recording_of_a_crash(tmp_path):
    path, before = tmp_path / "world.mcap", tmp_path / "world.before.mcap"
    path.touch()  # an empty one is not kept
    killed = started(path)
    write_down(killed, world_records(100))
    left = path.read_bytes()
    again = started(path)
    again.put(counted(3))
    again._close()
    assert before.read_bytes() == left
    assert len(Recording.read(before)["/odometry"]) == 100
    assert len(Recording.read(path)["/count"]) == 3
    killed._close()
    left = path.read_bytes()
    started(path)._close()
    assert before.read_bytes() == left, "only the previous one is kept"
    assert len(list(tmp_path.iterdir())) == 2
