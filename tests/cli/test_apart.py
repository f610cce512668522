"""A plug-in's code cannot move or mute the command that calls it."""

import json
import os
import sys

import pytest

from cloudrc import plugins
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
    sys.stdout = None
"""


def _spoil():
    print("text of the user")
    os.chdir("/")
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


def _exit_at_once(number):
    os._exit(number)


@pytest.mark.parametrize("status", [0, 3])
def test_a_worker_that_ends_itself_is_not_called_killed(status, monkeypatch):
    monkeypatch.setattr("cloudrc.runs.workers.usable_cores", lambda: 2)
    end = take_each(map_in_order(_exit_at_once, [status] * 2, 2), print)
    assert end.exit_code == 6
    assert str(end).startswith(f"a worker ended itself (exit status {status}); does a plug-in")
