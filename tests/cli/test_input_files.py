"""Input files of commands: a pipe or device is refused, a redirected file is read."""

import os
import signal

import pytest

from cloudrc.cli.main import main
from cloudrc.faults.schedule import Schedule, dump
from tests.record.conftest import world_records, write


@pytest.fixture
def no_waiting():
    """Fail a test that waits for a pipe."""

    def give_up(number, frame):
        raise TimeoutError("it waits")

    before = signal.signal(signal.SIGALRM, give_up)
    signal.alarm(5)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


@pytest.mark.parametrize("what", ["pipe", "/dev/null", "."])
def test_a_pipe_device_or_folder_is_refused_at_once(what, no_waiting, capsys):
    os.mkfifo("pipe")
    assert main(["recover", what]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert f"{what}: not a regular file; see 'cloudrc recover --help'" in line
    assert os.listdir() == ["pipe"]


def test_a_redirected_file_is_read(tmp_path):
    """As with `/dev/stdin` and '<'."""
    run = write(tmp_path / "run.mcap", world_records(50))
    with run.open("rb") as handed:
        words = ["recover", f"/dev/fd/{handed.fileno()}", "--to", str(tmp_path / "new.mcap")]
        assert main(words) == 0
    schedule = tmp_path / "schedule.yaml"
    schedule.write_text(dump(Schedule(1, duration=0.5)))
    with schedule.open("rb") as handed:
        assert main(["faults", "run", f"/dev/fd/{handed.fileno()}"]) == 0
