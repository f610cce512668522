# SPDX-License-Identifier: Apache-2.0

"""Flight files, and the supervisor of a local run: feeds, sockets, deadlines, the key."""

import json
import os
import stat
from contextlib import suppress
from pathlib import Path

import pytest

from cloudrc.drivers import local
from cloudrc.drivers.local import LocalRun
from cloudrc.drivers.machine import AwakeClock


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


@pytest.mark.parametrize("runtime", ["", "missing", "of_others"])
def test_a_flight_is_in_the_home_without_a_runtime_folder_of_ones_own(
    tmp_path, runtime, monkeypatch
):
    monkeypatch.setenv("XDG_RUNTIME_DIR", runtime and str(tmp_path / runtime))
    (tmp_path / "of_others").mkdir()
    (tmp_path / "of_others").chmod(0o777)
    with local.announced(tmp_path, ""):
        assert list(local.under_way()) == [tmp_path]
        assert (tmp_path / "home/.local/state/cloudrc/flights").is_dir()


def test_a_file_of_a_killed_run_is_removed(flights):
    (flights / "1.json").write_text(json.dumps({"run": "/r", "api": "", "kind": "run", "pid": 1}))
    assert local.flight_files() == {}
    assert list(flights.iterdir()) == []


def test_a_clock_does_not_count_the_time_of_a_pause():
    now = 0.0
    clock = AwakeClock(turn_max=1.0, clock=lambda: now)
    for step, shown in ((0.9, 0.9), (7.0, 0.9), (1.0, 1.9)):
        now += step
        assert clock() == pytest.approx(shown)
    assert clock.pause == 7.0


def test_the_key_of_a_run_is_for_its_user_alone_and_goes_with_it(tmp_path, monkeypatch):
    seen = []

    def look(run, limit, files):
        sockets = run._open(tmp_path, {}, files).sockets
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
