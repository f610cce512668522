# SPDX-License-Identifier: Apache-2.0

"""`cloudrc sweep`: the same table whether interrupted, in shards, in pods or at once.

`cloudrc run --seeds` prints one table of all seeds, or of the finished ones, and writes a sweep.
"""

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from cloudrc.base.source import code_hash
from cloudrc.cluster import batch
from cloudrc.flight.trials.plan import PlannedFlight, read_plan, unpack
from cloudrc.flight.trials.rows import read_rows
from cloudrc.flight.virtual.flight import assemble
from tests.conftest import wait_until
from tests.doors.cli.conftest import SHORT
from tests.support.sweeps import flown

ONE = {"cloud.predictor": ["constant_velocity"]}


pytestmark = pytest.mark.usefixtures("one_core")


def rows(folder):
    return list(read_rows(Path(folder)).values())


def test_shards_give_the_table_of_the_whole(write_sweep, call, as_json):
    file = write_sweep()
    said = call("sweep run --out whole", file)
    assert said.err == "steps: 4 points x 1 seeds: 4 flights\n"
    assert said.out.splitlines() == ["", "4 success", "", "whole/table.csv"]
    call("sweep run --out parts --shard 2/2", file)
    assert not Path("parts/table.csv").exists()
    call("sweep run --out parts --shard 1/2", file)
    assert {path.name for path in Path("parts").glob("rows*")} == {"rows-1.jsonl", "rows-2.jsonl"}
    assert Path("parts/table.csv").read_bytes() == Path("whole/table.csv").read_bytes()
    head, _, _, *cells = call("sweep status parts").out.splitlines()
    assert head == "4 of 4 flights are done: 4 success"
    assert [line.split() for line in cells][1] == ["cloud.predictor", "constant_velocity", "2/2"]
    assert as_json("sweep status parts")["rows"] == 4


def test_a_sweep_goes_on_where_it_ended(write_sweep, monkeypatch, call):
    """An interrupted one says how to go on; flights with a row are not flown again."""
    begun = []

    def fly(flight):
        begun.append(flight.seed)
        if len(begun) == 2:
            raise KeyboardInterrupt
        return play(flight)

    play = PlannedFlight.play
    monkeypatch.setattr(PlannedFlight, "play", fly)
    flags = "--max-flights 200000 --record failed"
    file = write_sweep(ONE, seeds=3)
    said = call(f"sweep run {flags}", file, code=130)
    assert said.out.endswith("runs/sweep-grid-1/sweep.json\n")
    assert "to continue, add --out runs/sweep-grid-1\n" in said.err
    assert Path("runs/latest-sweep").resolve() == Path("runs/sweep-grid-1").resolve()
    again = call(f"sweep run {flags} --out runs/sweep-grid-1", file).err
    assert "1 points x 3 seeds: 3 flights, 1 done before" in again
    assert begun == [1, 2, 2, 3]


def test_a_sweep_that_is_too_large_is_refused_before_it_is_checked(write_sweep, refused, call):
    axes = {f"guard.{key}": list(range(1, 1001)) for key in ("hold_max_s", "speed_max_mps")}
    error = refused("sweep run --out grid", write_sweep(axes, seeds=5))
    assert "5,000,000 flights are more than 100,000" in error
    assert not Path("grid").exists()
    call("sweep run --out grid --max-flights 1", write_sweep(ONE))


@pytest.mark.usefixtures("no_page")
def test_a_row_flies_again_to_the_same_hash(write_sweep, call):
    call("sweep run --out grid", write_sweep(ONE))
    (row,) = rows("grid")
    assert "the records are those of the sweep" in call("sweep fly grid", row["key"][:4]).err
    report = json.loads(Path(f"grid/{row['key']}/report.json").read_text())
    assert report["records_sha256"] == row["records_sha256"]
    assert report["code"] == row["code"] == code_hash()
    Path("grid/rows.jsonl").write_text(json.dumps(row | {"records_sha256": "f"}) + "\n")
    call("sweep fly grid x", code=2)
    assert "no file of its key has changed" in call("sweep fly grid", row["key"], code=6).err


def test_a_row_of_a_changed_file_is_not_flown_again(write_sweep, call):
    Path("mine.py").write_text("from cloudrc.cloud.predictors.last_sample import build\n")
    call("sweep run --out grid", write_sweep({"cloud.predictor": [str(Path("mine.py").resolve())]}))
    (row,) = rows("grid")
    Path("mine.py").write_text("from cloudrc.cloud.predictors.last_sample import build  # new\n")
    error = call("sweep fly grid", row["key"], code=2).err
    assert f"{row['key']}: changed since its flights: {Path('mine.py').resolve()}; fly" in error


def test_failed_flights_are_recorded_if_asked_for(write_sweep, call):
    file = write_sweep({"criteria.time_limit_s": [60, 0.5]})
    call("sweep run --out grid --record=failed", file, code=1)
    good, bad = rows("grid")
    assert (good["verdict"], bad["verdict"]) == ("success", "failure")
    assert "timed_out" in bad["failures"]
    assert Path(f"grid/{bad['key']}/mission.mcap").is_file()
    assert not Path(f"grid/{good['key']}").exists()
    call("sweep run --out grid --record=all", file, code=1)
    assert Path(f"grid/{good['key']}/mission.mcap").is_file()
    assert rows("grid") == [good, bad]


@pytest.fixture
def break_seed_2(monkeypatch):
    """Return a function that lets the flight with seed 2 meet an error."""

    def use(error):
        def fly(experiment, *given, **named):
            if experiment.seed == 2:
                raise error
            return assemble(experiment, *given, **named)

        monkeypatch.setattr("cloudrc.flight.virtual.flight.assemble", fly)

    return use


def test_an_error_becomes_a_row_and_the_others_fly(write_sweep, break_seed_2, call):
    break_seed_2(RuntimeError("no\x1b luck"))
    told = call("sweep run --out grid", write_sweep(ONE, seeds=[2, 1]), code=1).err
    bad, good = rows("grid")
    assert (bad["verdict"], bad["failures"], bad["numbers"]) == ("error", ["error"], {})
    assert good["verdict"] == "success"
    assert re.search(rf"{bad['key']}: error: test_sweep.py:\d+: RuntimeError: no\\x1b luck", told)


# An error of the machine says nothing about a flight: it ends the sweep, and no row is stored.


def test_an_error_of_the_machine_ends_a_sweep_and_is_no_row(break_seed_2, write_sweep, call):
    break_seed_2(MemoryError())
    error = call("sweep run --out grid", write_sweep(ONE, seeds=[1, 2, 3]), code=3).err
    line = error.splitlines()[-1]
    assert "memory ran out" in line
    assert "; to continue, give the same command again" in line
    assert [row["seed"] for row in rows("grid")] == [1]


@pytest.mark.process
def test_a_killed_sweep_continues_to_equal_bytes(write_sweep):
    """SIGKILL to the command, whose workers end with it."""
    file = str(write_sweep(seeds=4))
    command = [sys.executable, "-m", "cloudrc", "sweep", "run", file, "--jobs", "2", "--out"]
    with subprocess.Popen([*command, "killed"], stdout=subprocess.DEVNULL) as process:
        wait_until(lambda: rows("killed"))
        workers = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
        os.kill(process.pid, signal.SIGKILL)
    assert len(workers) >= 2
    wait_until(lambda: not any(Path(f"/proc/{worker}").exists() for worker in workers), 20.0)
    assert 0 < len(rows("killed")) < 16
    with Path("killed/rows.jsonl").open("ab") as torn:
        torn.write(b'{"key": "73')
    assert subprocess.run([*command, "killed"], check=False).returncode == 0
    assert subprocess.run([*command, "whole"], check=False).returncode == 0
    assert Path("killed/table.csv").read_bytes() == Path("whole/table.csv").read_bytes()


# Sweeps in pods: rows come from the lines of the pods' logs, each once.


class Release:
    where = "in namespace 'lab'"

    def patient(self, tell):
        return self


@pytest.fixture
def pods(monkeypatch):
    """Pods of new Jobs: settings and own files of each, and the lines that each Job's pods print.

    Without `lines`, they print the rows of all flights.
    """
    found = SimpleNamespace(jobs=[], lines=None)

    def start(release, name, flights, settings, own):
        found.jobs.append((settings, own))
        Path("flights").write_bytes(flights)

    def read_lines(*given):
        if found.lines is None:
            return [json.dumps(flight.row(flown())) for flight in unpack(Path("flights"))]
        return found.lines.pop(0) if found.lines else []

    monkeypatch.setattr("cloudrc.doors.cli.sweep_run.release_from_flags", lambda options: Release())
    monkeypatch.setattr(batch, "start", start)
    monkeypatch.setattr(batch, "read_lines", read_lines)
    return found


IN_PODS = "sweep run --out grid --on kubernetes"


def made(path):
    return [flight.row(flown()) for flight in read_plan(path).flights.values()]


def test_each_row_is_taken_once_and_other_lines_are_not(write_sweep, pods, call):
    path = write_sweep()
    lines = [json.dumps(row) for row in made(path)]
    foreign = json.dumps(made(path)[0] | {"key": "0"})
    others = ["", "a warning", '{"key": "x"}', "[1]", "2", foreign]
    pods.lines = [[*others, *lines[::-1], *lines]]
    call(IN_PODS, path)
    assert rows("grid") == made(path)[::-1]
    assert len(Path("grid/rows.jsonl").read_text().splitlines()) == 4


@pytest.mark.parametrize(
    ("jobs", "code", "count", "said"),
    [
        ([slice(3), slice(3, 4)], 0, 4, "rows of 1 flights were lost with their pods"),
        ([slice(1)], 5, 1, "the pods printed no row of 3 flights"),
    ],
)
def test_lost_rows_are_flown_again_as_long_as_rows_arrive(
    jobs, code, count, said, write_sweep, pods, call
):
    path = write_sweep()
    pods.lines = [[json.dumps(row) for row in made(path)[part]] for part in jobs]
    assert said in call(IN_PODS, path, code=code).err
    assert rows("grid") == made(path)[:count]


def test_files_of_plug_ins_travel_with_the_flights(write_sweep, pods, tmp_path, call):
    (tmp_path / "mine.py").write_text("from helper import build\n")
    (tmp_path / "helper.py").write_text("from cloudrc.cloud.predictors.last_sample import build\n")
    path = write_sweep({"cloud.predictor": ["./mine.py"]}, set={})
    call(IN_PODS, path)
    ((settings, own),) = pods.jobs
    assert own == [str(tmp_path / name) for name in ("helper.py", "mine.py")]
    assert settings.shards == 1, "at most one per flight"
    with (tmp_path / "helper.py").open("a") as file:
        file.write("# " + "x" * (1 << 20))
    error = call("sweep run --out large --on kubernetes", path, code=2).err
    assert "helper.py: your files have 1048" in error
    assert not Path("large").exists()


def test_a_client_that_has_gone_attaches_with_the_same_flags(write_sweep, pods, monkeypatch, call):
    def leave(*given):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(batch, "read_lines", leave)
        flags = "--claim rows --set-job nodeSelector.disk=ssd"
        error = call(f"{IN_PODS} {flags}", write_sweep(), code=130).err
    assert "to continue, cloudrc sweep attach grid" in error
    assert "rows in rows/sweep-" in error
    call("sweep attach grid")
    (first, _), (second, _) = pods.jobs
    assert first == second
    assert first.changes == {("nodeSelector", "disk"): "ssd"}
    assert Path("grid/table.csv").exists()
    assert "no folder of" in call("sweep attach .", code=2).err


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        ("--set-job toleration=1", "did you mean tolerations?"),
        ("--claim a --bucket s3://b", "two places"),
        ("--bucket lab", "is not s3://BUCKET"),
    ],
)
def test_odd_flags_of_pods_are_refused(write_sweep, flags, said, call):
    assert said in call(f"sweep run --on kubernetes {flags}", write_sweep(ONE), code=2).err
    assert not Path("runs").exists()


# `cloudrc run --seeds N`.


@pytest.mark.usefixtures("no_page")
def test_many_seeds_become_one_table_and_a_sweep(folder, call):
    """Missions that take too long have failed, and so has the command."""
    line = "run steps --seeds 2 --set criteria.time_limit_s=0.5"
    lines = call(line, *SHORT, code=1).out.splitlines()
    assert lines[-1] == "runs/steps-virtual-2seeds-1/sweep.json"
    assert lines[0] == "steps: mode virtual, seeds 1 to 2, link paper-p3"
    assert lines[1].startswith("    1/2  seed 1  failure: ")
    assert "done 0/2" in lines
    assert any(line.startswith("prediction_error_rms") for line in lines)
    assert not (folder / "runs/latest").exists()
    key = json.loads((folder / "runs/latest-sweep/rows.jsonl").read_text().splitlines()[1])["key"]
    assert "the records are those of the sweep" in call("sweep fly runs/latest-sweep", key).err
