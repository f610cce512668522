"""`cloudrc link verify` over real sockets and processes: verdicts, causes, exit codes."""

import json
import os
import subprocess
from functools import partial

import pytest

from cloudrc.cli import link_verify
from cloudrc.cli.link_verify import find_experiment, run_link
from cloudrc.config.schema import Profile
from cloudrc.errors import CloudrcError

# Far above what a machine adds that does other things, too.
LINK = ["link.uplink.delay_ms=100", "link.uplink.jitter_ms=40", "link.downlink.delay_ms=80"]
LINK += ["link.downlink.jitter_ms=30"]


@pytest.mark.process
def test_a_fault_is_named_on_the_command_line(call, monkeypatch):
    twice = {"delay_ms": 200.0, "jitter_ms": 40.0}, {"delay_ms": 160.0, "jitter_ms": 30.0}
    wrong = Profile.model_validate(dict(zip(("uplink", "downlink"), twice, strict=True)))
    monkeypatch.setattr(link_verify, "run_link", partial(run_link, applied=wrong))
    settings = [f"--set={value}" for value in LINK]
    report = json.loads(call("link verify paper-p1 --seconds 4 -o json", *settings, code=1).out)
    assert report["verdict"] == "not believed"
    assert {cause["code"] for cause in report["causes"]} - {"throttled"} == {"doubled_delay"}
    assert {row["name"] for row in report["directions"]["uplink"]["rows"]} >= {"mean", "loss"}


def test_netem_without_root_is_a_missing_prerequisite(monkeypatch, refused):
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    assert "needs root" in refused("link verify ideal --shaper netem", code=3)


@pytest.mark.parametrize(
    ("code", "words", "exit_code", "says"),
    [
        (2, "cloudrc: error: no such profile", 2, "the uplink is not shaped: no such profile"),
        (70, "internal error: X", 6, "not shaped: internal error: X (exit code 70)"),
        (0, "", 6, "it left no message (exit code 0)"),
    ],
)
def test_an_early_end_has_the_exit_code_of_the_process(code, words, exit_code, says, monkeypatch):
    def start(name, way, shaper):
        (way.folder / "log").write_text(f"before\n{words}\n" if words else "")
        return subprocess.Popen(["sh", "-c", f"exit {code}" if name == "uplink" else "sleep 9"])

    monkeypatch.setattr(link_verify, "_start", start)
    with pytest.raises(CloudrcError) as ended, run_link(find_experiment("paper-p1", []), "relay"):
        pass
    assert ended.value.exit_code == exit_code
    assert str(ended.value).endswith(says)
