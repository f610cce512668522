# SPDX-License-Identifier: Apache-2.0

"""Real time: a program outside controls the robot, started by `cloudrc run --with`."""

import json
import os
import sys
from pathlib import Path

import pytest

from cloudrc.base.errors import ControllerLostError
from cloudrc.doors.cli.main import main
from cloudrc.flight.local.companion import companion
from cloudrc.flight.pod.realtime import free_ports
from tests.conftest import wait_until

PROPORTIONAL = """
import os

count = 0

def infer(seen):
    global count
    count += 1
    if count > LAST:
        os._exit(7)
    way = [a - b for a, b in zip(seen["setpoint/position"], seen["position"])]
    return {"actions": [[0.8 * each for each in way] + [0.0]] * 5}
"""


def fly(tmp_path, last):
    policy, port = tmp_path / "p.py", free_ports(1)[0]
    policy.write_text(PROPORTIONAL.replace("LAST", str(last)))
    words = ["run", "hover", "--mode", "local", "--out", str(tmp_path / "run")]
    words += ["--set", f"cloud.controller={{name: remote, url: 'ws://127.0.0.1:{port}'}}"]
    words += ["--set", "mission.waypoints=[{position_m: [0.3, 0, 0.7], dwell_s: 0.5}]"]
    serve = f"{sys.executable} -m cloudrc policy serve {policy} --port {port}"
    code = main([*words, "--with", serve])
    return code, json.loads((tmp_path / "run" / "report.json").read_text())


@pytest.mark.process
def test_a_program_outside_flies_in_real_time_and_ends_with_the_flight(tmp_path):
    code, report = fly(tmp_path, 10**9)
    assert (code, report["verdict"]) == (0, "success"), report["failures"]
    log = (tmp_path / "run" / "with.log").read_text()
    assert "policy serve" in log.splitlines()[0]
    assert "ws://" in log.splitlines()[1]


@pytest.mark.process
def test_a_program_that_dies_in_real_time_ends_the_flight_after_5_s(tmp_path, capsys):
    code, report = fly(tmp_path, 30)
    assert code == 5
    assert report["failures"][0]["code"] == "controller_silent"
    error = capsys.readouterr().err.splitlines()[-1]
    assert "nobody listens" in error
    assert "has ended (exit code 7)" in error


@pytest.mark.process
def test_the_program_of_the_documentation_flies(tmp_path):
    text = (Path(__file__).parents[3] / "docs" / "remote.md").read_text()
    source = text.partition("```python\n")[2].partition("```")[0]
    port, program = free_ports(1)[0], tmp_path / "controller.py"
    program.write_text(source.replace("8000", str(port)))
    settings = [f"cloud.controller={{name: remote, url: 'ws://127.0.0.1:{port}'}}"]
    words = ["run", "hover", "--mode", "virtual", "--out", str(tmp_path / "run")]
    words += ["--set", *settings, "--with", f"{sys.executable} {program}"]
    assert main(words) == 0


@pytest.mark.process
def test_a_program_and_its_children_end_with_the_block_even_if_they_ignore_sigterm(tmp_path):
    with companion("sh -c 'trap \"\" TERM; sleep 600 & echo $!; wait'", tmp_path):
        while len(lines := (tmp_path / "with.log").read_text().splitlines()) < 2:
            pass
        child = int(lines[1])
        os.kill(child, 0)
    stat = Path(f"/proc/{child}/stat")
    wait_until(lambda: not stat.exists() or stat.read_text().split()[2] == "Z", 5)


def test_a_program_that_ends_before_it_listens_is_named_with_its_last_line(tmp_path):
    url = f"ws://127.0.0.1:{free_ports(1)[0]}"
    command = "sh -c 'echo no weights; exit 3'"
    with pytest.raises(ControllerLostError, match=r"exit code 3\): no weights"):
        with companion(command, tmp_path, url):
            pass
