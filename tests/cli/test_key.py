"""`cloudrc key`: make a key, rotate it, drop the old one."""

import os
import stat

import pytest

from cloudrc.cli.main import main
from cloudrc.drivers.keyfile import PERIOD_NS, KeyFile, read_keys
from cloudrc.tunnel.keys import KeySet


def test_a_key_is_made_rotated_and_dropped(tmp_path, capsys):
    path, link = tmp_path / "key", tmp_path / "link"
    os.umask(0o022)
    assert main(["key", "new", str(path)]) == 0
    first = read_keys(path).current
    assert capsys.readouterr().out == f"key {first.name}: {path}\n"
    assert read_keys(path) == KeySet(first)
    follower = KeyFile(path, 0)
    link.symlink_to(path)
    assert main(["key", "new", str(link), "--overlap", "600"]) == 0
    new, old = read_keys(path)
    assert old == first
    said, error = capsys.readouterr()
    assert said == f"key {new.name}, beside {first.name} until 'cloudrc key drop': {link}\n"
    assert error.startswith("cloudrc: --overlap is ignored: ")
    follower.follow(PERIOD_NS)
    assert follower.ring.keys == (new, first)
    for verb, said in (
        ("drop", f"key {new.name} is the only key now, {first.name} is removed: {path}\n"),
        ("retire", f"key {new.name} is the only key already: {path}\n"),
    ):
        assert main(["key", verb, str(path)]) == 0
        assert capsys.readouterr().out == said
        assert read_keys(path) == KeySet(new)
    follower.follow(2 * PERIOD_NS)
    assert follower.ring.keys.accepted == (new,)
    assert (link.is_symlink(), stat.S_IMODE(path.stat().st_mode)) == (True, 0o600)
    for more in ((), ("--drop",)):  # a second "new" replaces the second key
        before = read_keys(path).current
        assert main(["key", "new", str(path), *more]) == 0
        assert read_keys(path).previous == before


@pytest.mark.parametrize("verb", ["new", "drop"])
def test_a_file_that_is_no_key_is_refused_and_kept(verb, tmp_path, capsys):
    (tmp_path / "notes").write_text("my notes")
    assert main(["key", verb, str(tmp_path / "notes")]) == 2
    assert (tmp_path / "notes").read_text() == "my notes"
    assert main(["key", verb, str(tmp_path / "none" / "key")]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert first.startswith(f"cloudrc: error: {tmp_path / 'notes'}: ")
    assert "No such file" in second
