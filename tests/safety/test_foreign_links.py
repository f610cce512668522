"""Writing into a folder from somebody else follows no link there."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.errors import BadInputError
from cloudrc.files import atomic_file, write_atomically
from cloudrc.link.state import publish
from cloudrc.record.columns import Recording
from cloudrc.record.merge import merge
from cloudrc.record.reader import recover
from cloudrc.report.document import write_json
from cloudrc.report.folder import read_run
from cloudrc.report.write import write_report
from tests.record.conftest import cloud_records, world_records, write

HEX = b"\xab" * 8


@pytest.fixture(autouse=True)
def umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A file of the user that must not change."""
    path = tmp_path / "mine"
    path.write_text("mine")
    return path


@pytest.fixture
def theirs(tmp_path: Path) -> Path:
    """A folder from somebody else."""
    folder = tmp_path / "theirs"
    folder.mkdir()
    return folder


def recovered(path: Path) -> None:
    recover(write(path.with_name("torn.mcap"), world_records(20)), path)


def merged(path: Path) -> None:
    ends = (write(path.with_name(f"{n}.mcap"), world_records(20)) for n in range(2))
    merge(*ends).write(path)


WRITERS: list[Callable[[Path], object]] = [
    lambda path: write_atomically(path, b"new"),
    lambda path: publish(path, "new"),
    lambda path: write_json(path, {}),
    merged,
    recovered,
]


@pytest.mark.parametrize("writes", WRITERS)
def test_a_link_is_replaced_and_its_target_kept(
    theirs: Path, mine: Path, monkeypatch: pytest.MonkeyPatch, writes: Callable[[Path], object]
) -> None:
    path = theirs / "file"
    path.symlink_to(mine)
    for guess in (f".file.{os.getpid()}", ".file.part"):
        (theirs / guess).symlink_to(mine)
    writes(path)
    assert mine.read_text() == "mine"
    assert not path.is_symlink()
    assert path.stat().st_size
    # Even a link with the name of the temporary file is refused, not followed.
    monkeypatch.setattr(os, "urandom", lambda size: HEX)
    (theirs / f".file.{HEX.hex()}").symlink_to(mine)
    with pytest.raises(FileExistsError):
        writes(path)
    assert mine.read_text() == "mine"


@pytest.mark.parametrize("mode", [0o600, 0o644])
def test_a_secret_file_has_its_mode_from_the_start(theirs: Path, mode: int) -> None:
    path = theirs / "key"
    path.touch(0o644)
    path.with_name(f".key.{os.getpid()}").touch(
        0o666
    )  # the temporary file once took over this mode
    with atomic_file(path, mode) as file:
        assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == mode
    assert stat.S_IMODE(path.stat().st_mode) == mode
    assert main(["key", "new", str(theirs / "new")]) == 0
    assert stat.S_IMODE((theirs / "new").stat().st_mode) == 0o600


def test_a_failed_write_leaves_no_trace(theirs: Path) -> None:
    write_atomically(theirs / "file", b"old")
    with suppress(KeyboardInterrupt), atomic_file(theirs / "file") as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert os.listdir(theirs) == ["file"]
    assert (theirs / "file").read_bytes() == b"old"


def test_recover_refuses_a_broken_link(
    theirs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torn = write(theirs / "run.mcap", world_records(20))
    (theirs / "run.recovered.mcap").symlink_to(tmp_path / "nothing")
    assert main(["recover", str(torn)]) == 2
    assert "already there; name another file with --to" in capsys.readouterr().err
    assert not (tmp_path / "nothing").exists()


def test_a_report_follows_no_link(
    theirs: Path, mine: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cloudrc.report.figures.NAMES", ("error",))
    (theirs / "config.yaml").write_text("seed: 1")
    write(theirs / "world.mcap", world_records(20))
    write(theirs / "cloud.mcap", cloud_records(20))
    names = ("report.json", "environment.json", "report.html")
    for name in names:
        (theirs / name).symlink_to(mine)
    (theirs / "mission.mcap").symlink_to(tmp_path / "nothing")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (theirs / "figures").symlink_to(elsewhere)
    with pytest.raises(BadInputError, match="figures: is a link; remove it"):
        write_report(theirs, *read_run(theirs))
    (theirs / "figures").unlink()
    (theirs / "figures").mkdir()
    (theirs / "figures" / "error.png").symlink_to(mine)
    write_report(theirs, *read_run(theirs))
    assert mine.read_text() == "mine"
    assert not any(elsewhere.iterdir())
    assert not any((theirs / name).is_symlink() for name in (*names, "mission.mcap"))
    assert (theirs / "figures" / "error.png").read_bytes().startswith(b"\x89PNG")
    assert Recording.read(theirs / "mission.mcap").complete
