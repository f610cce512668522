"""Flight files tell only their user of a flight, and only during it."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from cloudrc.drivers import local
from cloudrc.drivers.local import LocalRun
from cloudrc.records import Record

KILLED = """
import os, signal, sys
from pathlib import Path
from cloudrc.drivers import local
with local.announced(Path(sys.argv[1])):
    assert local.under_way()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(autouse=True)
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    for name, folder in (("XDG_RUNTIME_DIR", "runtime"), ("XDG_STATE_HOME", "state")):
        (tmp_path / folder).mkdir()
        monkeypatch.setenv(name, str(tmp_path / folder))
    return local.places()


def test_a_flight_is_found_while_it_lasts_and_leaves_nothing(
    tmp_path: Path, places: list[Path]
) -> None:
    with local.announced(tmp_path / "a"):
        assert local.under_way() == {tmp_path / "a": ""}
        with local.announced(tmp_path / "b", "unix:/b.sock"):
            assert local.under_way() == {tmp_path / "b": "unix:/b.sock", tmp_path / "a": ""}
        assert list(local.under_way()) == [tmp_path / "a"]
    assert local.under_way() == {}
    assert list(places[0].iterdir()) == []


def test_it_is_told_by_its_whole_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with local.announced(Path("runs/hover-1")):
        monkeypatch.chdir("/")
        assert list(local.under_way()) == [tmp_path / "runs" / "hover-1"]


def test_a_flight_that_fails_is_over(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), local.announced(tmp_path):
        raise KeyboardInterrupt
    assert local.under_way() == {}


@pytest.mark.process
def test_a_flight_that_is_killed_is_over_and_is_cleared_away(
    tmp_path: Path, places: list[Path]
) -> None:
    ended = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path)], check=False)
    assert ended.returncode == -signal.SIGKILL
    (left,) = places[0].glob("*.json")
    assert json.loads(left.read_text())["run"] == str(tmp_path)
    assert local.under_way() == {}
    assert not left.exists()


def test_folder_and_files_are_this_users_alone(tmp_path: Path, places: list[Path]) -> None:
    with local.announced(tmp_path):
        (file,) = places[0].iterdir()
        assert stat.S_IMODE(places[0].stat().st_mode) == 0o700
        assert stat.S_IMODE(file.stat().st_mode) == 0o600


@pytest.mark.parametrize("mode", [0o777, 0o770, 0o500])
def test_an_unsafe_or_unwritable_first_folder_gives_the_second(
    tmp_path: Path, places: list[Path], mode: int
) -> None:
    if os.getuid() == 0 and mode == 0o500:
        places[0].parent.parent.joinpath("cloudrc").write_text(
            "in the way"
        )  # root ignores permissions
    else:
        places[0].mkdir(parents=True)
        places[0].chmod(mode)
    with local.announced(tmp_path):
        assert len(list(places[1].iterdir())) == 1
        assert list(local.under_way()) == [tmp_path]


def test_what_somebody_else_could_have_written_is_not_read(
    tmp_path: Path, places: list[Path]
) -> None:
    with local.announced(tmp_path):
        places[0].chmod(0o777)
        assert local.under_way() == {}
        places[0].chmod(0o700)
        (file,) = places[0].iterdir()
        file.chmod(0o640)
        assert local.under_way() == {}
        file.chmod(0o600)
        assert list(local.under_way()) == [tmp_path]


def test_another_users_folder_is_neither_read_nor_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with local.announced(tmp_path / "a"):
        assert list(local.under_way()) == [tmp_path / "a"]
        monkeypatch.setattr(os, "getuid", lambda: os.stat(tmp_path).st_uid + 1)
        assert local.under_way() == {}
        (tmp_path / "state" / "cloudrc" / "flights").mkdir(parents=True, mode=0o700)
        with local.announced(tmp_path / "b") as told:
            assert not told


def test_where_nothing_can_be_written_it_flies_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(local, "places", lambda: [Path("/proc/nowhere")])
    with local.announced(tmp_path) as told:
        assert not told
        assert local.under_way() == {}


@pytest.mark.parametrize("api", [True, False])
def test_an_unannounced_flight_names_the_flag_for_its_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, api: bool
) -> None:
    monkeypatch.setattr(LocalRun, "_fly", lambda *_: None)
    said: list[Record] = []
    LocalRun(tmp_path, said.extend, api=api).fly(1.0)
    assert said == []
    monkeypatch.setattr(local, "places", list)
    LocalRun(tmp_path, said.extend, api=api).fly(1.0)
    assert ["--api unix:/" in str(record) for record in said] == [True] * api


def test_a_file_that_says_nothing_is_no_flight(places: list[Path]) -> None:
    places[0].mkdir(parents=True, mode=0o700)
    with local.announced(Path("a")):
        (file,) = places[0].iterdir()
        file.write_text("[]")
        assert local.under_way() == {}
