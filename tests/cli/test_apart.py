"""A plug-in's code cannot move or mute the command that calls it."""

import os

import pytest

from cloudrc.trials.workers import map_in_order, take_each


def _exit_at_once(number):
    os._exit(number)


@pytest.mark.parametrize("status", [3])
def test_a_worker_that_ends_itself_is_not_called_killed(status, monkeypatch):
    monkeypatch.setattr("cloudrc.trials.workers.usable_cores", lambda: 2)
    end = take_each(map_in_order(_exit_at_once, [status] * 2, 2), print)
    assert end.exit_code == 6
    assert str(end).startswith(f"a worker ended itself (exit status {status}); does a plug-in")
