"""`cloudrc key`: an old key stays valid for its overlap, and a link stays a link."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.drivers.keyfile import PERIOD_NS, KeyFile, read_keys
from cloudrc.tunnel.keys import Key, KeySet, write

FIRST, SECOND = b"1" * 32, b"2" * 32


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "key").write_bytes(FIRST)
    return tmp_path / "key"


def test_a_second_rotation_within_the_overlap_is_refused(
    path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else an end that reads the file late would share no key with the other."""
    early, late = KeyFile(path, 0), KeyFile(path, 0)
    wall = [1_800_000_000.0]
    monkeypatch.setattr(time, "time", lambda: wall[0])
    assert main(["key", "new", str(path)]) == 0
    assert early.follow(PERIOD_NS)
    rotated = path.read_bytes()
    for later, left in ((0.0, 300), (299.5, 1)):
        wall[0] += later
        capsys.readouterr()
        assert main(["key", "new", str(path), "--overlap", "60"]) == 2
        error = f"the old key {Key(FIRST).name} is valid for {left} s more; wait, or revoke"
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"cloudrc: error: {path}: {error}")
        assert "cloudrc key new FILE --drop" in line
        assert path.read_bytes() == rotated
    assert not early.follow(2 * PERIOD_NS)
    assert late.ring.current in early.ring.accepted(2 * PERIOD_NS)
    second = read_keys(path).current
    wall[0] += 0.5
    assert main(["key", "new", str(path)]) == 0
    assert read_keys(path).previous == second


def test_drop_revokes_the_old_key_at_once(path: Path) -> None:
    assert main(["key", "new", str(path)]) == 0
    follower, second = KeyFile(path, 0), read_keys(path).current
    assert main(["key", "new", str(path), "--drop"]) == 0
    keys = read_keys(path)
    assert keys.previous == second
    follower.follow(PERIOD_NS)
    assert follower.ring.accepted(PERIOD_NS) == (keys.current, second)


def test_drop_needs_an_existing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["key", "new", str(tmp_path / "none"), "--drop"]) == 2
    assert "there is no old key to revoke" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("verb", ["new", "retire"])
def test_a_file_without_a_key_is_kept_and_gives_one_line(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "odd\x1b[31m"
    path.write_bytes(b"my thesis")
    assert main(["key", verb, str(path)]) == 2
    error = capsys.readouterr().err
    assert path.read_bytes() == b"my thesis"
    assert (error.count("\n"), error.isprintable(), "--key" in error) == (1, False, False)
    assert "\x1b" not in error
    path.write_bytes(FIRST)
    assert main(["key", verb, str(path)]) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_a_file_without_a_time_can_be_rotated(path: Path) -> None:
    """Nothing says how long to wait."""
    path.write_text(write(KeySet(Key(SECOND), Key(FIRST))))
    assert main(["key", "new", str(path)]) == 0
    assert read_keys(path).previous == Key(SECOND)


def test_a_link_stays_a_link_and_its_target_gets_the_key(path: Path) -> None:
    link = path.with_name("link")
    link.symlink_to("key")
    follower = KeyFile(path, 0)
    assert main(["key", "new", str(link)]) == 0
    assert link.is_symlink()
    assert read_keys(path).previous == Key(FIRST)
    follower.follow(PERIOD_NS)
    assert follower.ring.current == read_keys(link).current
    assert main(["key", "retire", str(link)]) == 0
    assert link.is_symlink()
    assert read_keys(path).previous is None
    path.unlink()
    assert main(["key", "new", str(link)]) == 0
    assert read_keys(path).previous is None
