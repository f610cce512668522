"""What the link's process gives the sidecar: threads that look again and again."""

from __future__ import annotations

import pytest

from cloudrc.cli import link_run


class EndOfTestError(Exception):
    """Who acts for ever never ends."""


def test_the_runner_repeats_with_a_pause_after_each_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    done: list[object] = []

    def sleep(pause: float) -> None:
        done.append(pause)
        if len(done) == 40:
            raise EndOfTestError

    monkeypatch.setattr(link_run.time, "sleep", sleep)
    with pytest.raises(EndOfTestError):
        link_run._again_and_again((0.5, 1.0), lambda: done.append("acted"))
    assert done[::2] == ["acted"] * 20
    pauses = [pause for pause in done[1::2] if isinstance(pause, float)]
    assert len(set(pauses)) == 20  # by chance: many releases do not ask at once
    assert all(0.5 <= pause <= 1.0 for pause in pauses)


def test_a_pause_without_a_range_is_that_pause(monkeypatch: pytest.MonkeyPatch) -> None:
    def sleep(pause: float) -> None:
        assert pause == 0.05
        raise EndOfTestError

    monkeypatch.setattr(link_run.time, "sleep", sleep)
    with pytest.raises(EndOfTestError):
        link_run._again_and_again((0.05, 0.05), lambda: None)
