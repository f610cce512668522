"""No flight is flown by two commands into one folder at the same time."""

import errno
import fcntl

import pytest

from cloudrc.errors import BadInputError
from cloudrc.runs.lock import lock_folder


@pytest.mark.parametrize(
    ("first", "second", "said"),
    [
        ((), (), "another command flies into it now"),
        ((), (1, 2), "another command flies into it now"),
        ((1, 2), (), "another command flies into it now"),
        ((1, 2), (1, 2), "another command flies shard 1 of 2 into it now"),
        ((1, 2), (2, 4), "shards of another number than 4 fly into it now"),
        ((1, 2), (2, 2), ""),
        ((3, 16), (13, 16), ""),
    ],
)
def test_two_commands_never_fly_the_same_flights(first, second, said, tmp_path):
    with lock_folder(tmp_path, *first) as warning:
        assert warning == ""
        if said:
            with pytest.raises(BadInputError, match=said), lock_folder(tmp_path, *second):
                pass
        else:
            with lock_folder(tmp_path, *second) as warning:
                assert warning == ""
    with lock_folder(tmp_path, *second) as warning:  # the first command has ended
        assert warning == ""


def test_a_refused_command_holds_no_lock(tmp_path):
    with lock_folder(tmp_path, 1, 2), pytest.raises(BadInputError), lock_folder(tmp_path, 2, 4):
        pass
    with lock_folder(tmp_path):
        pass


@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL])
def test_a_file_system_without_locks_is_told(number, tmp_path, monkeypatch):
    def refuse(file, how):
        raise OSError(number, "refused")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with lock_folder(tmp_path, 1, 2) as warning, lock_folder(tmp_path, 1, 2):
        assert "its file system has no locks (refused); do not start the same sweep" in warning


def test_a_folder_that_cannot_be_written_is_no_missing_lock(tmp_path):
    (tmp_path / ".lock").mkdir()
    with pytest.raises(IsADirectoryError), lock_folder(tmp_path):
        pass
