"""`cloudrc link verify` over real sockets and processes: what it believes, and what it names."""

import json
import os
import signal
import subprocess
import threading
from functools import partial

import pytest

from cloudrc.cli import link_verify
from cloudrc.cli.link_verify import find_experiment, make_plans, probe_link, run_link
from cloudrc.cli.main import main
from cloudrc.config.schema import Profile
from cloudrc.errors import CloudrcError
from cloudrc.link.verify.causes import find_causes
from cloudrc.link.verify.judge import verdict_of

# Far above what a machine adds that does other things, too.
LINK = ["link.uplink.delay_ms=100", "link.uplink.jitter_ms=40", "link.downlink.delay_ms=80"]
LINK += ["link.downlink.jitter_ms=30"]


def asked(*settings):
    kept = [one for one in LINK if not any(one.split("=")[0] in new for new in settings)]
    return find_experiment("paper-p1", [*kept, *settings])


def probe(experiment, applied=None, around=False):
    """Probe a link of another profile `applied`, or `around` its shapers."""
    with run_link(experiment, "relay", applied) as ways:
        for way in ways.values():
            if around:
                (way.folder / "route").write_text(f"{way.peer[0]}:{way.peer[1]}\n")
        return probe_link(ways, make_plans(experiment, 4.0, "relay"))


def codes(found):
    return {cause.code for cause in find_causes(found)}


@pytest.mark.process
def test_an_honest_link_is_believed_unless_the_machine_delays_it():
    found = probe(asked())
    for rows, known in found.values():
        if "throttled" not in codes(found):  # the suite runs on machines that do other things, too
            assert verdict_of(rows) == "ok"
        assert (known.shaper, known.layers, known.passed) == ("relay", 1, known.sent)


@pytest.mark.process
def test_a_fault_is_named_on_the_command_line(capsys, monkeypatch):
    both = {"uplink": {"delay_ms": 200.0, "jitter_ms": 40.0},
            "downlink": {"delay_ms": 160.0, "jitter_ms": 30.0}}  # fmt: skip
    wrong = Profile.model_validate(both)
    monkeypatch.setattr(link_verify, "run_link", partial(run_link, applied=wrong))
    words = ["link", "verify", "paper-p1", "--seconds", "4", "-o", "json"]
    words += [word for value in LINK for word in ("--set", value)]
    assert main(words) == 1
    report = json.loads(capsys.readouterr().out)
    assert report["verdict"] == "not believed"
    assert {cause["code"] for cause in report["causes"]} - {"throttled"} == {"doubled_delay"}
    assert {row["name"] for row in report["directions"]["uplink"]["rows"]} >= {"mean", "loss"}


@pytest.mark.process
@pytest.mark.full
def test_a_relay_without_its_cpu_is_named(monkeypatch):
    """Both shapers are stopped as a CPU limit does: 60 ms of every 100."""
    true, over = link_verify.send_probes, threading.Event()
    with run_link(asked(), "relay") as ways:

        def throttle():
            while not over.wait(0.04):
                for number, pause in ((signal.SIGSTOP, 0.06), (signal.SIGCONT, 0.0)):
                    for way in ways.values():
                        assert way.process is not None
                        way.process.send_signal(number)
                    over.wait(pause)

        def held_up(ends):
            thread = threading.Thread(target=throttle)
            thread.start()
            try:
                return true(ends)
            finally:
                over.set()
                thread.join()

        monkeypatch.setattr(link_verify, "send_probes", held_up)
        assert "throttled" in codes(probe_link(ways, make_plans(asked(), 4.0, "relay")))


@pytest.mark.process
@pytest.mark.full
def test_a_bypass_is_named():
    assert codes(probe(asked(), around=True)) == {"bypassed"}


RATE = ["link.uplink.rate_kbit=4000", "link.uplink.keep_order=true", "link.uplink.jitter_ms=3"]


@pytest.mark.process
@pytest.mark.full
@pytest.mark.parametrize(
    ("settings", "changed", "fault"),
    [([], {"delay_ms": 0.0, "jitter_ms": 0.0}, "one_direction"),
     (RATE, {"rate_kbit": None}, "rate_ignored")],
)  # fmt: skip
def test_a_fault_of_the_uplink_is_named(settings, changed, fault):
    experiment = asked(*settings)
    uplink = experiment.uplink.model_copy(update=changed)
    found = codes(probe(experiment, Profile(uplink=uplink, downlink=experiment.downlink)))
    assert found - {"throttled"} == {fault}, "the machine may delay the shapers"


def test_netem_without_root_is_a_missing_prerequisite(monkeypatch, capsys):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert main(["link", "verify", "ideal", "--shaper", "netem"]) == 3
    said = capsys.readouterr().err.strip()
    assert "needs root" in said
    assert "\n" not in said


@pytest.mark.parametrize(
    ("code", "words", "exit_code", "says"),
    [
        (2, "cloudrc: error: no such profile", 2, "the uplink is not shaped: no such profile"),
        (2, "cannot; set link.mode=relay, which can", 2, "cannot; use --shaper relay, which can"),
        (4, "too slow", 4, "too slow"),
        (70, "internal error: X", 6, "not shaped: internal error: X (exit code 70)"),
        (0, "", 6, "it left no message (exit code 0)"),
    ],
)
def test_an_early_end_has_the_exit_code_of_the_process(code, words, exit_code, says, monkeypatch):
    def start(name, way, shaper):
        (way.folder / "log").write_text(f"before\n{words}\n" if words else "")
        return subprocess.Popen(["sh", "-c", f"exit {code}" if name == "uplink" else "sleep 9"])

    monkeypatch.setattr(link_verify, "_start", start)
    with pytest.raises(CloudrcError) as ended, run_link(asked(), "relay"):
        pass
    assert ended.value.exit_code == exit_code
    assert str(ended.value).endswith(says)
