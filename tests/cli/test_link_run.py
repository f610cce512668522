"""`cloudrc link run`: threads that repeat an action."""

from __future__ import annotations

import pytest

from cloudrc.cli import link_run


class EndOfTestError(Exception):
    """End the endless loop of the test."""


def test_an_action_repeats_with_a_random_pause_each_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[object] = []

    def sleep(pause: float) -> None:
        done.append(pause)
        if len(done) == 40:
            raise EndOfTestError

    monkeypatch.setattr(link_run.time, "sleep", sleep)
    with pytest.raises(EndOfTestError):
        link_run._repeat_forever((0.5, 1.0), lambda: done.append("acted"))
    assert done[::2] == ["acted"] * 20
    pauses = [pause for pause in done[1::2] if isinstance(pause, float)]
    assert len(set(pauses)) == 20  # random, so that many releases do not ask at once
    assert all(0.5 <= pause <= 1.0 for pause in pauses)


def test_a_range_of_one_value_gives_that_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    def sleep(pause: float) -> None:
        assert pause == 0.05
        raise EndOfTestError

    monkeypatch.setattr(link_run.time, "sleep", sleep)
    with pytest.raises(EndOfTestError):
        link_run._repeat_forever((0.05, 0.05), lambda: None)
