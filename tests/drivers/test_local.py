"""Flight files, and the supervisor of a local run: feeds, sockets, deadlines, the key."""

import json
import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest

from cloudrc.drivers import local
from cloudrc.drivers.local import LocalRun, socket_folder
from cloudrc.drivers.machine import Deadline


@pytest.fixture(autouse=True)
def flights(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))  # if others may write to `tmp_path`
    return local.flights_folder()


def test_a_flight_is_found_while_it_lasts_and_leaves_nothing(tmp_path, flights, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with suppress(KeyboardInterrupt), local.announced(Path("runs/a"), ""):
        monkeypatch.chdir("/")
        assert local.under_way() == {tmp_path / "runs" / "a": ""}
        assert stat.S_IMODE(flights.stat().st_mode) == 0o700
        with local.announced(tmp_path / "b", "unix:/b.sock"):
            assert local.under_way()[tmp_path / "b"] == "unix:/b.sock"
        assert list(local.under_way()) == [tmp_path / "runs" / "a"]
        raise KeyboardInterrupt
    assert list(flights.iterdir()) == []


@pytest.mark.parametrize("runtime", ["", "missing"])
def test_a_flight_is_in_the_home_without_a_runtime_folder(tmp_path, runtime, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setenv("XDG_RUNTIME_DIR", runtime and str(tmp_path / runtime))
    (tmp_path / "of_others").mkdir()
    (tmp_path / "of_others").chmod(0o777)
    with local.announced(tmp_path, ""):
        assert list(local.under_way()) == [tmp_path]
        assert (tmp_path / "home/.local/state/cloudrc/flights").is_dir()


@pytest.mark.parametrize("where", ["folder", "above"])
def test_a_flight_file_that_others_may_write_is_ignored(tmp_path, flights, where):
    with local.announced(tmp_path, "") as reason:
        assert reason == ""
        (file,) = flights.iterdir()
        {"folder": flights, "above": tmp_path}[where].chmod(0o777)
        assert local.under_way() == {}
        if where == "folder":
            with local.announced(tmp_path / "b", "") as reason:
                assert "everybody may write" in reason
        tmp_path.chmod(0o700)
        flights.chmod(0o700)
        assert file.exists()


def test_sockets_lie_in_a_folder_with_a_short_path(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / ("x" * 90)))
    (tmp_path / ("x" * 90)).mkdir()
    for folder, chosen in (("/short", "/short"), ("/" + "x" * 90, "/tmp")):
        monkeypatch.setattr(tempfile, "tempdir", folder)
        assert socket_folder() == chosen
    monkeypatch.setenv("XDG_RUNTIME_DIR", "")
    monkeypatch.setenv("HOME", "/proc/no-home")  # nothing can be made there
    assert socket_folder() == "/tmp"


def test_the_sockets_of_a_killed_run_are_removed(flights, tmp_path):
    sockets, other = flights.parent / "cloudrc-1234", tmp_path / "cloudrc-5678"
    for number, folder in enumerate((sockets, other)):
        folder.mkdir(parents=True)
        flights.mkdir(exist_ok=True, mode=0o700)
        flight = {"run": "/r", "api": f"unix:{folder}/api.sock", "kind": "run", "pid": 1}
        (flights / f"{number}.json").write_text(json.dumps(flight))
    assert local.flight_files() == {}
    assert (sockets.exists(), other.exists()) == (False, True)


def test_a_deadline_does_not_count_the_time_of_a_pause():
    now = 0.0
    deadline = Deadline(3.0, turn_max=1.0, clock=lambda: now)
    for step, passed in ((0.9, False), (7.0, False), (0.9, False), (1.0, False), (0.9, True)):
        now += step
        assert deadline.passed() is passed
    assert deadline.pause == 7.0


def test_the_key_of_a_run_is_for_its_user_alone_and_goes_with_it(tmp_path, monkeypatch):
    seen = []

    def look(run, limit, sockets, url):
        key = sockets / "key"
        seen.append((key, key.stat().st_mode, sockets.stat().st_mode))

    monkeypatch.setattr(LocalRun, "_fly", look)
    before = os.umask(0)  # a user whose new files are open to all
    try:
        LocalRun(tmp_path, lambda records: None).fly(1.0)
    finally:
        os.umask(before)
    ((key, *modes),) = seen
    assert [stat.S_IMODE(mode) for mode in modes] == [0o600, 0o700]
    assert not key.exists()
