# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link verify` over real sockets and processes: verdicts, causes, exit codes."""

import json
import os
import subprocess

import pytest

from cloudrc.base.errors import CloudrcError
from cloudrc.flight.links import under_test, verify
from cloudrc.flight.links.under_test import run_link
from cloudrc.flight.links.verify import find_experiment, make_plans, probe_link
from cloudrc.link.verify import verdict_of
from cloudrc.link.verify.causes import find_causes

# Far above what a machine adds that does other things, too.
LINK = ["link.uplink.delay_ms=100", "link.uplink.jitter_ms=40", "link.downlink.delay_ms=80"]
LINK += ["link.downlink.jitter_ms=30"]


@pytest.mark.process
@pytest.mark.alone
def test_an_honest_link_is_verified_unless_the_machine_delays_it():
    experiment = find_experiment("paper-p1", LINK)
    with run_link(experiment, "relay") as ways:
        found = probe_link(ways, make_plans(experiment, 2.0, "relay"))
    codes = {cause.code for cause in find_causes(found)}
    for rows, known, _ in found.values():
        if "throttled" not in codes:  # the suite runs on machines that do other things, too
            assert verdict_of(rows) == "ok"
        assert (known.shaper, known.layers, known.passed) == ("relay", 1, known.sent)


@pytest.mark.process
@pytest.mark.alone
def test_a_relay_gives_packets_the_slots_that_virtual_time_gives_them():
    keys = ["phase_ms=6", "drift_ppm=50"]
    experiment = find_experiment("5g-sa", [f"link.uplink.radio.{key}" for key in keys])
    with run_link(experiment, "relay") as ways:
        found = probe_link(ways, make_plans(experiment, 3.0, "relay"))
    codes = {cause.code for cause in find_causes(found)}
    for rows, known, _ in found.values():
        phase = next(row for row in rows if row.name == "phase")
        assert (phase.verdict == "told") == bool(known.starved)
        if "throttled" not in codes:
            assert verdict_of(rows) == "ok"


@pytest.mark.process
@pytest.mark.alone
def test_a_fault_is_named_on_the_command_line(call, monkeypatch):
    twice = [one.replace("=100", "=200").replace("=80", "=160") for one in LINK]
    wrong = find_experiment("paper-p1", twice)
    monkeypatch.setattr(verify, "run_link", lambda _, shaper: run_link(wrong, shaper))
    settings = [f"--set={value}" for value in LINK]
    report = json.loads(call("link verify paper-p1 --seconds 2 -o json", *settings, code=1).out)
    assert report["verdict"] == "not believed"
    assert {cause["code"] for cause in report["causes"]} - {"throttled"} == {"doubled_delay"}
    assert {row["name"] for row in report["directions"]["uplink"]["rows"]} >= {"mean", "loss"}


def test_netem_without_root_is_a_missing_prerequisite(monkeypatch, refused):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert "needs root" in refused("link verify ideal --shaper netem", code=3)


@pytest.mark.parametrize(("code", "exit_code"), [(2, 2), (70, 6)])
def test_an_early_end_has_the_exit_code_of_the_process(code, exit_code, monkeypatch):
    def start(name, way, shaper):
        (way.folder / "log").write_text("before\ncloudrc: error: no such profile\n")
        return subprocess.Popen(["sh", "-c", f"exit {code}" if name == "uplink" else "sleep 9"])

    monkeypatch.setattr(under_test, "_start", start)
    says = "the uplink is not shaped: no such profile"
    experiment = find_experiment("paper-p1", [])
    with pytest.raises(CloudrcError, match=says) as ended, run_link(experiment, "relay"):
        pass
    assert ended.value.exit_code == exit_code
