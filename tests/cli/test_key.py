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
        ("drop", f"key {new.name} is the only key already: {path}\n"),
    ):
        assert main(["key", verb, str(path)]) == 0
        assert capsys.readouterr().out == said
        assert read_keys(path) == KeySet(new)
    follower.follow(2 * PERIOD_NS)
    assert follower.ring.keys.accepted == (new,)
    assert (link.is_symlink(), stat.S_IMODE(path.stat().st_mode)) == (True, 0o600)
    for _ in range(2):  # a second "new" replaces the second key
        before = read_keys(path).current
        assert main(["key", "new", str(path)]) == 0
        assert read_keys(path).previous == before
    path.write_bytes(b"1" * 32)
    assert main(["key", "drop", str(path)]) == 0
    assert path.read_bytes() == b"1" * 32, "one key, in its old form"


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
def test_a_file_that_is_no_key_is_refused_and_kept(verb, name, data, said, tmp_path, capsys):
    if data is not None:
        (tmp_path / name).write_bytes(data)
    assert main(["key", verb, str(tmp_path / name)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert "--key" not in line
    assert "\x1b" not in line
    assert [each.read_bytes() for each in tmp_path.iterdir()] == ([data] if data else [])
