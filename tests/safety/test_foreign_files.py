# SPDX-License-Identifier: Apache-2.0

"""Files from somebody else: cloudrc waits for no pipe, limits sizes, and follows no link."""

import os
import signal
import stat
from contextlib import suppress
from pathlib import Path

import pytest

from cloudrc.base import files
from cloudrc.base.errors import BadInputError
from cloudrc.base.files import atomic_file, write_atomically
from cloudrc.config.load import read_experiment
from cloudrc.config.profile import load_profile
from cloudrc.flight.trials.plan import read_plan
from cloudrc.link.traces import read_trace
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.figures import FIGURES
from cloudrc.results.report.folder import read_run
from cloudrc.results.report.write import write_report
from tests.results.record.conftest import cloud_records, world_records, write


@pytest.fixture(autouse=True)
def no_waiting():
    """End a test that waits for a pipe, and not all tests."""

    def end(number, frame):
        pytest.fail("it waits")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(120)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


READERS = (read_experiment, load_profile, read_trace, read_plan, Recording.read)


@pytest.mark.parametrize("read", READERS)
def test_a_pipe_or_device_is_refused_at_once(tmp_path, read):
    os.mkfifo(tmp_path / "pipe")
    before = os.listdir("/proc/self/fd")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(BadInputError, match=r"^[^\n]*not a file; (give|name) a [^\n]*$"):
            read(path)
    assert len(os.listdir("/proc/self/fd")) == len(before)


def test_what_is_beyond_the_limit_is_refused_and_not_cut(tmp_path):
    """Files of /proc claim to be empty, and so does a file that grows during the read."""
    for size in (0, 1, 99, 100):
        (tmp_path / "a").write_bytes(bytes(size))
        assert files.read(tmp_path / "a", 100) == bytes(size)
    (tmp_path / "a").write_bytes(bytes(101))
    for path in (tmp_path / "a", Path("/proc/self/status")):
        with pytest.raises(files.TooLongError, match="longer than 100 bytes"):
            files.read(path, 100)


# Links.


@pytest.fixture
def mine(tmp_path):
    """A file of the user that must not change."""
    path = tmp_path / "mine"
    path.write_text("mine")
    return path


@pytest.fixture
def theirs(tmp_path):
    """A folder from somebody else."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    return folder


WRITERS = [
    lambda path: write_atomically(path, b"new"),
    lambda path: Recording.from_records(world_records(20), []).write(path),
]


@pytest.mark.parametrize("writes", WRITERS)
def test_a_link_is_replaced_and_its_target_kept(theirs, mine, writes):
    path = theirs / "file"
    path.symlink_to(mine)
    writes(path)
    assert mine.read_text() == "mine"
    assert not path.is_symlink()
    assert path.stat().st_size


def test_a_secret_file_has_its_mode_from_the_start(theirs):
    path = theirs / "key"
    path.touch(0o644)
    with atomic_file(path, 0o600) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == 0o600
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_failed_write_leaves_no_trace(theirs):
    write_atomically(theirs / "file", b"old")
    with suppress(KeyboardInterrupt), atomic_file(theirs / "file") as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert os.listdir(theirs) == ["file"]
    assert (theirs / "file").read_bytes() == b"old"


def test_a_report_follows_no_link(theirs, mine, tmp_path, monkeypatch):
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {"error": FIGURES["error"]})
    (theirs / "config.yaml").write_text("seed: 1")
    write(theirs / "world.mcap", world_records(20))
    write(theirs / "cloud.mcap", cloud_records(20))
    names = ("report.json", "environment.json", "report.html", "mission.mcap")
    for name in names:
        (theirs / name).symlink_to(mine if name != "mission.mcap" else tmp_path / "nothing")
    (theirs / "figures").symlink_to(tmp_path)
    write_report(theirs, *read_run(theirs), figures=True)
    assert not (theirs / "figures").is_symlink()
    assert mine.read_text() == "mine"
    assert sorted(os.listdir(tmp_path)) == ["mine", "theirs"]
    assert not any((theirs / name).is_symlink() for name in names)
