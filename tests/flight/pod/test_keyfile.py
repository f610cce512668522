# SPDX-License-Identifier: Apache-2.0

"""An end reads its key file at the start, and follows it in flight."""

import os

import pytest

from cloudrc.flight.pod.keyfile import PERIOD_NS, KeyFile
from cloudrc.wire.tunnel.keys import Key, KeySet, write

FIRST, SECOND = Key(b"1" * 32), Key(b"2" * 32)


def put(path, data):
    """Replace a file atomically, as kubelet does."""
    draft = path.with_name("draft")
    draft.write_bytes(data)
    draft.replace(path)


@pytest.fixture
def path(tmp_path):
    (tmp_path / "key").write_bytes(b"1" * 32)
    return tmp_path / "key"


@pytest.fixture
def keys(path):
    return KeyFile(path, 0)


def test_a_file_is_followed_twice_a_second(path, keys):
    now_ns, before = 0, keys.ring.keys
    put(path, write(KeySet(FIRST)).encode())  # the same key in other words
    assert keys.follow(0) == []
    assert keys.ring.keys is before
    for new, said in (
        (KeySet(SECOND, FIRST), f"new key {SECOND.name}; {FIRST.name} is accepted, too"),
        (KeySet(SECOND), f"key {SECOND.name}; no other is accepted"),
        (KeySet(FIRST), f"new key {FIRST.name}; no other is accepted"),
    ):
        put(path, write(new).encode())
        assert keys.follow(now_ns + PERIOD_NS - 1) == []
        now_ns += PERIOD_NS
        (told,) = keys.follow(now_ns)
        assert (told.code, told.text) == ("key", said)
        assert keys.ring.keys == new
    path.unlink()  # for a moment
    assert keys.follow(now_ns + PERIOD_NS) == []
    assert keys.ring.keys == new


@pytest.mark.parametrize("wrong", [b"3" * 31, "pipe"])
@pytest.mark.fault(
    38,
    "secret-wrong",
    injects="the key file is wrong",
    expects="the keys in use stay; it is told once, and the next good file counts",
)
def test_a_wrong_file_leaves_the_keys_and_is_told_once(wrong, path, keys):
    """A reader of a pipe would stop the loop."""
    if wrong == "pipe":
        path.unlink()
        os.mkfifo(path)
    else:
        put(path, wrong)
    (said,) = keys.follow(PERIOD_NS)
    assert said.text.startswith(f"the old keys stay in use: --key {path}: ")
    assert said.text.endswith("; make one: cloudrc key new FILE")
    assert keys.follow(2 * PERIOD_NS) == []
    assert keys.ring.keys.current == FIRST
    put(path, b"2" * 32)
    keys.follow(3 * PERIOD_NS)
    assert keys.ring.keys.current == SECOND


def test_each_robot_of_a_fleet_has_keys_of_its_own(path):
    keys = [KeyFile(path, 0, robot).ring.keys.current for robot in (None, 0, 1)]
    assert len({key.name for key in keys}) == 3
    put(path, write(KeySet(SECOND, FIRST)).encode())
    assert KeyFile(path, 0, 1).ring.keys.previous == keys[2]
