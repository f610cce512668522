# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link`: its actions, traces of runs and logs, pictures of profiles."""

import pytest

from cloudrc.doors.cli.main import main
from cloudrc.link.traces import read_table, read_trace


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A flight of some seconds over a link with losses."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    line = f"run steps --mode virtual --set mission.steps.count=2 --out {folder} -o json"
    assert main([*line.split(), "--set", "link.profile=lossy", "--report", "none"]) == 0
    return folder


def test_a_run_gives_a_trace_per_direction(run, folder, call):
    said = call("link record -o trace.csv", run).out
    for way in ("uplink", "downlink"):
        trace = read_trace(folder / f"trace-{way}.csv")
        assert len(trace.times) > 700
        assert 0.005 < sum(trace.losses) / len(trace.losses) < 0.15
        assert 0.020 <= min(trace.delays) < max(trace.delays) <= 0.080
        assert f"--set link.{way}.trace=trace-{way}.csv" in said
        assert f"distribution: table, table: trace-{way}.csv" in said
        assert read_table(folder / f"trace-{way}.csv")
    call("link record -o t.csv --direction downlink", run / "mission.mcap")
    assert (folder / "t.csv").read_bytes() == (folder / "trace-downlink.csv").read_bytes()


def test_a_trace_replaces_no_file(folder, call, refused):
    log = "time_s,delay_ms\n0,45\n1,46\n"
    (folder / "log.csv").write_text(log)
    (folder / "same.csv").symlink_to("log.csv")
    for name in ("log.csv", "same.csv"):
        assert f"{name}: already there" in refused(f"link record log.csv -o {name}")
    assert (folder / "log.csv").read_text() == log


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("verify nonsense", "no profile or experiment named 'nonsense'"),
        ("verify lossy --shaper netem", "lasts); use the relay"),
    ],
)
def test_a_wrong_line_is_refused(line, says, refused):
    assert says in refused(f"link {line}")


def test_a_profile_is_drawn_and_its_statistics_printed(folder, call):
    lines = call("link show handover --seconds 12 -o a.svg").out.splitlines()
    assert lines[0].startswith("handover: LTE")
    assert lines[1].split() == ["one", "way", "uplink", "downlink"]
    assert lines[2].split()[0] == "mean"
    assert 25.0 < float(lines[2].split()[1]) < 35.0
    assert lines[-1] == "a.svg"
    assert (folder / "a.svg").read_text().startswith("<?xml")


def test_a_radio_is_shown_with_its_delays_at_random_phases(folder, call):
    said = call("link show 5g-sa --packets 1000 -o a.svg").out
    rows = {line[:26].strip(): line[26:].split() for line in said.splitlines()}
    assert rows["smallest at random phases"] == ["6", "3.5", "ms"]
    assert rows["mean at random phases"] == ["11", "4.05", "ms"]
    assert rows["largest at random phases"] == ["16", "5", "ms"]
    assert rows["more by repetitions, mean"] == ["0.5556", "0.5556", "ms"]
