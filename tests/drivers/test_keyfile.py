"""The key file is made by a command, followed in flight and never shown."""

from __future__ import annotations

import argparse
import os
import stat
import time
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cli.runtime import _open_keys
from cloudrc.drivers import keyfile
from cloudrc.drivers.keyfile import PERIOD_NS, KeyFile, is_exposed, read_keys
from cloudrc.errors import BadInputError
from cloudrc.tunnel.keys import Key, KeySet, parse, write

CONFIG = Path(__file__).parents[2] / "cloudrc" / "experiments" / "hover.yaml"
FIRST, SECOND = b"1" * 32, b"2" * 32


def put(path: Path, data: bytes) -> None:
    """Replace a file atomically, as kubelet does."""
    draft = path.with_name("draft")
    draft.write_bytes(data)
    draft.replace(path)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "key").write_bytes(FIRST)
    return tmp_path / "key"


def test_a_file_that_stays_changes_nothing(path: Path) -> None:
    keys = KeyFile(path, 0)
    assert [keys.follow(n * PERIOD_NS) for n in range(5)] == [[]] * 5
    assert keys.ring.accepted(0) == (Key(FIRST),)


def test_a_new_key_is_taken_and_the_old_one_is_valid_beside_it(path: Path) -> None:
    keys = KeyFile(path, 0)
    keys.follow(0)
    put(path, SECOND)
    assert keys.follow(PERIOD_NS - 1) == []  # the next check is not due yet
    (said,) = keys.follow(PERIOD_NS)
    assert said.code == "key"
    assert keys.ring.accepted(PERIOD_NS) == (Key(SECOND), Key(FIRST))


def test_the_overlap_of_the_file_counts_from_its_reading(path: Path) -> None:
    keys = KeyFile(path, 0)
    put(path, write(KeySet(Key(SECOND), Key(FIRST), 10.0)).encode())
    read_ns = 77_000_000_000
    keys.follow(read_ns)
    assert len(keys.ring.accepted(read_ns + 9_999_999_999)) == 2
    assert keys.ring.accepted(read_ns + 10_000_000_000) == (Key(SECOND),)


def test_the_same_key_in_another_file_is_no_news(path: Path) -> None:
    keys = KeyFile(path, 0)
    put(path, FIRST)
    assert keys.follow(PERIOD_NS) == []


@pytest.mark.parametrize("wrong", [b"", b"no key", b"3" * 31])
def test_a_file_that_is_wrong_leaves_the_keys_and_is_told_once(path: Path, wrong: bytes) -> None:
    keys = KeyFile(path, 0)
    put(path, wrong)
    (said,) = keys.follow(PERIOD_NS)
    assert said.text.startswith("the old keys stay in use: ")
    assert keys.follow(2 * PERIOD_NS) == []
    assert keys.ring.current == Key(FIRST)
    put(path, SECOND)
    keys.follow(3 * PERIOD_NS)
    assert keys.ring.current == Key(SECOND)


def test_a_file_unreadable_for_a_while_is_read_once_it_can_be(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A change of permissions does not change a file's version."""
    keys = KeyFile(path, 0)
    put(path, SECOND)
    with monkeypatch.context() as forbidden:
        forbidden.setattr(keyfile, "read", forbid)
        (said,) = keys.follow(PERIOD_NS)
        assert "Permission denied" in said.text
        assert keys.follow(2 * PERIOD_NS) == []
    keys.follow(3 * PERIOD_NS)
    assert keys.ring.current == Key(SECOND)


def forbid(*args: object) -> None:
    raise PermissionError(13, "Permission denied")


def test_a_file_that_is_gone_leaves_the_keys(path: Path) -> None:
    keys = KeyFile(path, 0)
    path.unlink()
    assert keys.follow(PERIOD_NS) == []
    assert keys.ring.current == Key(FIRST)


@pytest.mark.parametrize("end", ["world", "cloud"])
@pytest.mark.parametrize(
    ("data", "said"),
    [(None, "No such file"), (b"short", "neither 32 bytes nor lines"), (b"", "expected the line")],
)
def test_an_end_without_a_key_does_not_start(
    end: str,
    data: bytes | None,
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
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


def test_the_command_makes_a_key_that_only_its_owner_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "key"
    os.umask(0o022)
    assert main(["key", "new", str(path)]) == 0
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    keys = parse(path.read_bytes())
    assert keys.previous is None
    said = capsys.readouterr().out
    assert keys.current.name in said
    assert keys.current.text() not in said


def test_the_command_rotates_a_key(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "key"
    path.write_bytes(FIRST)
    assert main(["key", "new", str(path), "--overlap", "60"]) == 0
    keys = parse(path.read_bytes())
    assert (keys.previous, keys.overlap) == (Key(FIRST), 60.0)
    assert main(["key", "new", str(path), "--drop"]) == 0
    again = parse(path.read_bytes())
    assert (again.previous, again.overlap) == (keys.current, 300.0)
    assert keys.current.text() not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["new", "{}/none", "--overlap", "5"], "there is no old key to keep"),
        (["new", "{}/key", "--overlap", "0"], "not above 0"),
        (["new", "{}/key", "--overlap", "nan"], "not above 0"),
        (["new", "{}/key", "--overlap", "soon"], "not above 0"),
        (["new", "{}/wrong"], "neither 32 bytes"),
        (["new", "{}/no/key"], "No such file"),
        (["retire", "{}/none"], "No such file"),
        (["retire", "{}/wrong"], "neither 32 bytes"),
    ],
)
def test_what_the_command_cannot_do_it_says_in_a_line(
    words: list[str], said: str, path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (path.parent / "wrong").write_bytes(b"what is this")
    assert main(["key", *(word.format(path.parent) for word in words)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert len(error.splitlines()) == 1
    assert path.read_bytes() == FIRST
    assert sorted(p.name for p in path.parent.iterdir()) == ["key", "wrong"]


def test_a_rotation_says_until_when_the_key_before_is_valid(path: Path) -> None:
    before = time.time()
    assert main(["key", "new", str(path), "--overlap", "60"]) == 0
    until = read_keys(path).until
    assert until is not None
    assert before + 60.0 <= until <= time.time() + 61.0


@pytest.mark.promise("old-keys-expire")
@pytest.mark.parametrize("later", [60.0, 61.0, 1e6])
def test_a_start_after_the_overlap_refuses_the_previous_key(path: Path, later: float) -> None:
    assert main(["key", "new", str(path), "--overlap", "60"]) == 0
    keys = read_keys(path)
    assert keys.until is not None
    made = keys.until - 60.0
    fresh = KeyFile(path, 0, made + 59.0)
    assert fresh.ring.accepted(0) == (keys.current, Key(FIRST))
    assert fresh.ring.accepted(1_000_000_000) == (keys.current,)
    assert fresh.follow(0) == []
    late = KeyFile(path, 0, made + later)
    assert late.ring.accepted(0) == (keys.current,)
    (said,) = late.follow(0)
    assert f"the previous key {Key(FIRST).name} is refused" in said.text
    assert late.follow(PERIOD_NS) == []


def test_what_is_wrong_at_the_start_hides_no_new_key(path: Path) -> None:
    put(path, write(KeySet(Key(SECOND), Key(FIRST), 10.0)).encode())
    keys = KeyFile(path, 0, 1e9)
    put(path, FIRST)
    (said,) = keys.follow(0)
    assert "has no expiry time" in said.text
    (said,) = keys.follow(PERIOD_NS)
    assert said.text.startswith(f"new key {Key(FIRST).name}")


@pytest.mark.promise("old-keys-expire")
def test_an_end_asks_the_wall_clock_as_it_reads_its_key(
    path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert main(["key", "new", str(path), "--overlap", "60"]) == 0
    options = argparse.Namespace(key=path)
    assert len(_open_keys(options).ring.accepted(time.monotonic_ns())) == 2
    later = time.time() + 62.0
    monkeypatch.setattr(time, "time", lambda: later)
    assert len(_open_keys(options).ring.accepted(time.monotonic_ns())) == 1


def test_a_retired_key_is_gone_from_the_file_and_its_readers(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["key", "retire", str(path)]) == 0
    assert "is the only key already" in capsys.readouterr().out
    assert path.read_bytes() == FIRST
    assert main(["key", "new", str(path)]) == 0
    follower, made = KeyFile(path, 0, time.time()), read_keys(path)
    assert len(follower.ring.accepted(0)) == 2
    capsys.readouterr()
    assert main(["key", "retire", str(path)]) == 0
    said = f"key {made.current.name} is the only key now, {Key(FIRST).name} is removed: {path}\n"
    assert capsys.readouterr().out == said
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert read_keys(path) == KeySet(made.current)
    (told,) = follower.follow(PERIOD_NS)
    assert told.text == f"key {made.current.name} alone; the previous one is no longer valid"
    assert follower.ring.accepted(PERIOD_NS) == (made.current,)


def test_other_words_about_the_key_before_are_no_new_key(path: Path) -> None:
    put(path, write(KeySet(Key(SECOND), Key(FIRST), 10.0)).encode())
    keys = KeyFile(path, 0)
    put(path, write(KeySet(Key(SECOND), Key(FIRST), 60.0)).encode())
    (said,) = keys.follow(PERIOD_NS)
    assert said.text == f"key {Key(SECOND).name} unchanged; the entry of the previous one changed"
    assert keys.ring.accepted(10_000_000_000) == (Key(SECOND),)


def test_a_huge_file_is_not_read_whole(tmp_path: Path) -> None:
    (tmp_path / "key").write_bytes(b"#" * 10_000_000)
    with pytest.raises(BadInputError, match=r"--key \S+/key: longer than 4096 bytes; make one"):
        read_keys(tmp_path / "key")


def test_a_pipe_instead_of_the_file_is_not_read_and_keys_stay(path: Path) -> None:
    """A reader of a pipe would wait for a writer and stop the loop."""
    keys = KeyFile(path, 0)
    keys.follow(0)
    path.unlink()
    os.mkfifo(path)
    text = write(KeySet(Key(SECOND))).encode().ljust(keyfile.SIZE_MAX, b"\n")
    pipe = os.open(path, os.O_RDWR)  # a writer, so that the test cannot block
    try:
        os.write(pipe, text)
        (said,) = keys.follow(PERIOD_NS)
        assert said.text.startswith(f"the old keys stay in use: --key {path}: not a file; ")
        assert os.read(pipe, 2 * len(text)) == text
    finally:
        os.close(pipe)
    assert keys.ring.current == Key(FIRST)


def test_a_key_that_cannot_be_written_names_the_requested_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "no" / "folder" / "k"
    assert main(["key", "new", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"cloudrc: error: {path}: No such file or directory; name a file in")
