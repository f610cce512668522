"""An end reads its key file at the start, and follows it in flight."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.drivers import keyfile
from cloudrc.drivers.keyfile import PERIOD_NS, KeyFile, is_exposed, read_keys
from cloudrc.errors import BadInputError
from cloudrc.tunnel.keys import Key, KeySet, write

CONFIG = Path(__file__).parents[2] / "cloudrc" / "experiments" / "hover.yaml"
FIRST, SECOND = Key(b"1" * 32), Key(b"2" * 32)


def put(path: Path, data: bytes) -> None:
    """Replace a file atomically, as kubelet does."""
    draft = path.with_name("draft")
    draft.write_bytes(data)
    draft.replace(path)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "key").write_bytes(b"1" * 32)
    return tmp_path / "key"


@pytest.fixture
def keys(path: Path) -> KeyFile:
    keys = KeyFile(path, 0)
    assert keys.follow(0) == []
    return keys


def test_a_file_that_stays_changes_nothing(path: Path, keys: KeyFile) -> None:
    before = keys.ring.keys
    put(path, write(KeySet(FIRST)).encode())  # the same key in other words
    path.with_name("other").touch()
    assert [keys.follow(n * PERIOD_NS) for n in range(1, 5)] == [[]] * 4
    path.unlink()  # for a moment
    assert keys.follow(5 * PERIOD_NS) == []
    assert keys.ring.keys is before


def test_a_file_is_followed_twice_a_second(path: Path, keys: KeyFile) -> None:
    now_ns = 0
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


@pytest.mark.parametrize("wrong", [b"", b"no key", b"3" * 31, bytes(32)])
def test_a_wrong_file_leaves_the_keys_and_is_told_once(
    path: Path, keys: KeyFile, wrong: bytes
) -> None:
    put(path, wrong)
    (said,) = keys.follow(PERIOD_NS)
    assert said.text.startswith("the old keys stay in use: ")
    assert keys.follow(2 * PERIOD_NS) == []
    assert keys.ring.keys.current == FIRST
    put(path, b"2" * 32)
    keys.follow(3 * PERIOD_NS)
    assert keys.ring.keys.current == SECOND


def test_a_file_unreadable_for_a_while_is_read_once_it_can_be(
    path: Path, keys: KeyFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change of permissions does not change a file's version."""

    def forbid(*args: object) -> None:
        raise PermissionError(13, "Permission denied")

    put(path, b"2" * 32)
    with monkeypatch.context() as forbidden:
        forbidden.setattr(keyfile, "read", forbid)
        (said,) = keys.follow(PERIOD_NS)
        assert "Permission denied" in said.text
        assert keys.follow(2 * PERIOD_NS) == []
    keys.follow(3 * PERIOD_NS)
    assert keys.ring.keys.current == SECOND


def test_a_pipe_or_huge_file_is_not_read(path: Path, keys: KeyFile) -> None:
    """A reader of a pipe would wait for a writer and stop the loop."""
    path.unlink()
    os.mkfifo(path)
    text = write(KeySet(SECOND)).encode().ljust(keyfile.SIZE_MAX, b"\n")
    pipe = os.open(path, os.O_RDWR)  # a writer, so that the test cannot block
    try:
        os.write(pipe, text)
        (said,) = keys.follow(PERIOD_NS)
        assert said.text.startswith(f"the old keys stay in use: --key {path}: not a file; ")
        assert os.read(pipe, 2 * len(text)) == text
    finally:
        os.close(pipe)
    put(path, b"#" * 10_000_000)
    with pytest.raises(BadInputError, match=r"--key \S+/key: longer than 4096 bytes; make one"):
        read_keys(path)
    assert keys.ring.keys.current == FIRST


@pytest.mark.parametrize("end", ["world", "cloud"])
@pytest.mark.parametrize(
    ("data", "said"),
    [
        (None, "No such file"),
        (b"short", "neither 32 bytes nor lines"),
        (bytes(32), "an all-zero key is refused"),
    ],
)
def test_an_end_without_a_key_does_not_start(
    end: str, data: bytes | None, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    key = tmp_path / "key"
    if data is not None:
        key.write_bytes(data)
    words = ["--config", str(CONFIG), "--listen", "127.0.0.1:7499", "--peer", "127.0.0.1:9"]
    assert main([end, *words, "--key", str(key)]) == 2
    error = capsys.readouterr().err
    assert f"--key {key}: {said}" in error
    assert "cloudrc key new FILE" in error
    assert main([end, *words]) == 2
    assert "--key" in capsys.readouterr().err


def test_a_file_that_everybody_can_read_is_noticed(path: Path) -> None:
    path.chmod(0o600)
    assert not is_exposed(path)
    path.chmod(0o644)
    assert is_exposed(path)
