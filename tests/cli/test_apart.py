"""A plug-in's code cannot move or mute the command that calls it."""

import json
import os

import pytest

from cloudrc.trials.workers import map_in_order, take_each
from tests.cli.conftest import FLY


def test_what_plugins_print_is_not_part_of_the_result(folder, capsys):
    from cloudrc.cli.main import main

    (folder / "metric.py").write_text(
        'UNIT = "1"\ndef measure(flight):\n    print("text of the user")\n    return 1.0\n'
    )
    asked = "--set=report.metrics=[./metric.py]"
    assert main([*FLY, asked, "--out", "run", "-o", "json"]) == 0
    printed = capsys.readouterr()
    assert json.loads(printed.out)["numbers"]["metric"]["value"] == 1.0
    assert "text of the user" in printed.err


def _exit_at_once(number):
    os._exit(number)


@pytest.mark.parametrize("status", [0, 3])
def test_a_worker_that_ends_itself_is_not_called_killed(status, monkeypatch):
    monkeypatch.setattr("cloudrc.trials.workers.usable_cores", lambda: 2)
    end = take_each(map_in_order(_exit_at_once, [status] * 2, 2), print)
    assert end.exit_code == 6
    assert str(end).startswith(f"a worker ended itself (exit status {status}); does a plug-in")
