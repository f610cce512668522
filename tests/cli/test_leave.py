"""A plug-in's code cannot move, close or hold up the command that calls it."""

import json
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from cloudrc import plugins
from cloudrc.drivers.machine import interpreter
from cloudrc.runs.leave import limit_exit
from cloudrc.runs.workers import map_in_order, take_each
from tests.cli.conftest import FLY

METRIC = """
import os, sys, threading, time
UNIT = "1"
def measure(flight):
    return 1.0
def spoil():
    print("text of the user")
    os.chdir("/")
    sys.stdout.close()
    sys.stderr.close()
    sys.stdout = None
"""


def _spoil():
    print("text of the user")
    os.chdir("/")
    sys.stdout.close()
    sys.stderr.close()
    sys.stdout = None


def test_a_plugin_keeps_folder_and_streams_of_the_command(folder, capsys):
    out = sys.stdout
    with plugins.apart():
        _spoil()
    print("result")
    assert (os.getcwd(), sys.stdout) == (str(folder), out)
    assert capsys.readouterr() == ("result\n", "text of the user\n")


def test_what_plugins_print_is_not_part_of_the_result(folder, capsys):
    from cloudrc.cli.main import main

    body = METRIC.replace("return 1.0", "spoil()\n    return 1.0") + "spoil()\n"
    (folder / "metric.py").write_text(body)
    asked = "--set=report.metrics=[./metric.py]"
    assert main([*FLY, asked, "--out", "run", "-o", "json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["numbers"]["metric"]["value"] == 1.0
    assert (folder / "run" / "report.json").is_file()


def test_a_thread_that_never_ends_does_not_hold_up_the_exit(folder):
    (folder / "metric.py").write_text(
        f"{METRIC}threading.Thread(target=time.sleep, args=[1e5]).start()\n"
    )
    line = ["-m", "cloudrc", "report", "nowhere", "--metric", "./metric.py"]
    (folder / "nowhere").mkdir()
    done = subprocess.run(interpreter(*line), capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.splitlines()[1:] == [
        "cloudrc: warning: a plug-in has left a thread running; it was ended"
    ]


def _leave_thread(number):
    threading.Thread(target=time.sleep, args=[1e5]).start()
    return number


def _exit_at_once(number):
    os._exit(number)


def test_a_thread_in_a_worker_does_not_hold_up_the_command(monkeypatch):
    monkeypatch.setattr("cloudrc.runs.workers.usable_cores", lambda: 2)
    began = time.monotonic()
    assert [*map_in_order(_leave_thread, range(2), 2)] == [0, 1]
    assert time.monotonic() - began < 60.0


@pytest.mark.parametrize("status", [0, 3])
def test_a_worker_that_ends_itself_is_not_called_killed(status, monkeypatch):
    monkeypatch.setattr("cloudrc.runs.workers.usable_cores", lambda: 2)
    end = take_each(map_in_order(_exit_at_once, [status] * 2, 2), print)
    assert end.exit_code == 6
    assert str(end).startswith(f"a worker ended itself (exit status {status}); does a plug-in")


def test_a_timer_of_a_plug_in_does_not_change_the_exit_code():
    signal.setitimer(signal.ITIMER_REAL, 60.0)
    limit_exit(1)
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)


def test_a_process_without_foreign_threads_ends_as_usual(monkeypatch):
    monkeypatch.setattr(threading, "enumerate", lambda: [threading.current_thread()])
    monkeypatch.setattr(threading, "Timer", None)
    limit_exit(0)
