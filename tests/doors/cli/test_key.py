# SPDX-License-Identifier: Apache-2.0

"""`cloudrc key`: make a key, rotate it, drop the old one."""

import os
import stat

import pytest

from cloudrc.flight.pod.keyfile import read_keys
from cloudrc.wire.tunnel.keys import KeySet


@pytest.fixture
def key(tmp_path, call):
    """Return a function that changes the key file, and returns what was printed."""
    return lambda verb, more="": call(f"key {verb} {tmp_path / 'key'} {more}")


def test_a_key_is_made_rotated_and_dropped(tmp_path, key):
    path = tmp_path / "key"
    os.umask(0o022)
    said = key("new").out
    first = read_keys(path).current
    assert (said, read_keys(path)) == (f"key {first.name}: {path}\n", KeySet(first))
    path.rename(tmp_path / "real")
    path.symlink_to(tmp_path / "real")  # it stays a link
    said = key("new").out
    new, old = read_keys(path)
    assert old == first
    assert said == f"key {new.name}, beside {first.name} until 'cloudrc key drop': {path}\n"
    for _ in range(2):
        assert key("drop").out == f"key {new.name} is the only key: {path}\n"
        assert read_keys(path) == KeySet(new)
    assert (path.is_symlink(), stat.S_IMODE(path.stat().st_mode)) == (True, 0o600)


@pytest.mark.parametrize(
    ("verb", "name", "data", "said"),
    [
        ("new", "odd\x1b[31m", b"my thesis", "expected the line"),
        ("drop", "zeros", bytes(32), "an all-zero key is refused"),
    ],
)
def test_a_file_that_is_no_key_is_refused_and_kept(verb, name, data, said, tmp_path, refused):
    (tmp_path / name).write_bytes(data)
    line = refused(f"key {verb}", tmp_path / name)
    assert said in line
    assert "--key" not in line
    assert "\x1b" not in line
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [data]
