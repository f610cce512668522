"""`cloudrc key`: make a key, rotate it, drop the old one."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.drivers.keyfile import PERIOD_NS, KeyFile, read_keys
from cloudrc.tunnel.keys import Key, KeySet

FIRST = Key(b"1" * 32)
Captured = pytest.CaptureFixture[str]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "key").write_bytes(b"1" * 32)
    return tmp_path / "key"


def test_new_makes_a_key_that_only_its_owner_reads(tmp_path: Path, capsys: Captured) -> None:
    path = tmp_path / "key"
    os.umask(0o022)
    assert main(["key", "new", str(path)]) == 0
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    keys = read_keys(path)
    assert keys.previous is None
    assert capsys.readouterr().out == f"key {keys.current.name}: {path}\n"


def test_new_keeps_the_present_key_and_drop_ends_it(path: Path, capsys: Captured) -> None:
    follower = KeyFile(path, 0)
    assert main(["key", "new", str(path)]) == 0
    new, old = read_keys(path)
    assert old == FIRST
    said = f"key {new.name}, beside {FIRST.name} until 'cloudrc key drop': {path}\n"
    assert capsys.readouterr() == (said, "")
    follower.follow(PERIOD_NS)
    assert follower.ring.keys == (new, FIRST)
    for verb, said in (
        ("drop", f"key {new.name} is the only key now, {FIRST.name} is removed: {path}\n"),
        ("retire", f"key {new.name} is the only key already: {path}\n"),
    ):
        assert main(["key", verb, str(path)]) == 0
        assert capsys.readouterr().out == said
        assert read_keys(path) == KeySet(new)
    follower.follow(2 * PERIOD_NS)
    assert follower.ring.keys.accepted == (new,)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_second_new_replaces_the_second_key(path: Path) -> None:
    for more in ((), ("--drop",)):
        before = read_keys(path).current
        assert main(["key", "new", str(path), *more]) == 0
        assert read_keys(path).previous == before


def test_overlap_is_ignored_with_one_line(path: Path, capsys: Captured) -> None:
    assert main(["key", "new", str(path), "--overlap", "600"]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert line == (
        "cloudrc: --overlap is ignored: the old key is accepted until 'cloudrc key drop'"
    )
    assert read_keys(path).previous == FIRST


@pytest.mark.parametrize(
    ("verb", "name", "data", "said"),
    [
        ("new", "no/key", None, "No such file or directory; name a file in an existing"),
        ("new", "odd\x1b[31m", b"my thesis", "expected the line"),
        ("new", "zeros", bytes(32), "an all-zero key is refused"),
        ("drop", "none", None, "No such file"),
        ("drop", "odd", b"my thesis", "expected the line"),
    ],
)
def test_what_it_cannot_do_it_says_in_one_line(
    verb: str, name: str, data: bytes | None, said: str, tmp_path: Path, capsys: Captured
) -> None:
    path = tmp_path / name
    if data is not None:
        path.write_bytes(data)
    assert main(["key", verb, str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert "--key" not in line
    assert "\x1b" not in line
    assert [each.read_bytes() for each in tmp_path.iterdir()] == ([data] if data else [])


def test_a_link_stays_a_link_and_its_target_gets_the_key(path: Path) -> None:
    link = path.with_name("link")
    link.symlink_to("key")
    for verb, previous in (("new", FIRST), ("drop", None)):
        assert main(["key", verb, str(link)]) == 0
        assert link.is_symlink()
        assert read_keys(path).previous == previous
    path.unlink()
    assert main(["key", "new", str(link)]) == 0
    assert read_keys(path).previous is None
