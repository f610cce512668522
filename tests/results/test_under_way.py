# SPDX-License-Identifier: Apache-2.0

"""Flight files: who finds a flight, for how long, and in which folder."""

import json
import stat
from contextlib import suppress
from pathlib import Path

import pytest

from cloudrc.results import under_way


@pytest.fixture(autouse=True)
def flights(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path / "home"))  # if others may write to `tmp_path`
    return under_way.flights_folder()


def test_a_flight_is_found_while_it_lasts_and_leaves_nothing(tmp_path, flights, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with suppress(KeyboardInterrupt), under_way.announced(Path("runs/a"), ""):
        monkeypatch.chdir("/")
        assert under_way.under_way() == {tmp_path / "runs" / "a": ""}
        assert stat.S_IMODE(flights.stat().st_mode) == 0o700
        with under_way.announced(tmp_path / "b", "unix:/b.sock"):
            assert under_way.under_way()[tmp_path / "b"] == "unix:/b.sock"
        assert list(under_way.under_way()) == [tmp_path / "runs" / "a"]
        raise KeyboardInterrupt
    assert list(flights.iterdir()) == []


@pytest.mark.parametrize("runtime", ["", "missing", "of_others"])
def test_a_flight_is_in_the_home_without_a_runtime_folder_of_ones_own(
    tmp_path, runtime, monkeypatch
):
    monkeypatch.setenv("XDG_RUNTIME_DIR", runtime and str(tmp_path / runtime))
    (tmp_path / "of_others").mkdir()
    (tmp_path / "of_others").chmod(0o777)
    with under_way.announced(tmp_path, ""):
        assert list(under_way.under_way()) == [tmp_path]
        assert (tmp_path / "home/.local/state/cloudrc/flights").is_dir()


def test_a_file_of_a_killed_run_is_removed(flights):
    (flights / "1.json").write_text(json.dumps({"run": "/r", "api": "", "kind": "run", "pid": 1}))
    assert under_way.flight_files() == {}
    assert list(flights.iterdir()) == []
