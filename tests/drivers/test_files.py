"""Foreign files are read completely or not at all, and never block."""

from pathlib import Path

import pytest

from cloudrc import files


def test_what_is_beyond_the_limit_is_refused_and_not_cut(tmp_path):
    """Files of /proc claim to be empty, and so does a file that grows during the read."""
    for size in (0, 1, 99, 100):
        (tmp_path / "a").write_bytes(bytes(size))
        assert files.read(tmp_path / "a", 100) == bytes(size)
    (tmp_path / "a").write_bytes(bytes(101))
    for path in (tmp_path / "a", Path("/proc/self/status")):
        with pytest.raises(files.TooLongError, match="longer than 100 bytes"):
            files.read(path, 100)
