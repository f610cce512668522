"""What is asked of the recording of a real flight: HOLDs for want of commands, and no others."""

from __future__ import annotations

from pathlib import Path

import pytest

from cloudrc.faults.held import age_at_hold, holds, words
from cloudrc.faults.real.processes import throttled
from cloudrc.messages import ZERO, GuardState
from cloudrc.record.columns import Recording
from cloudrc.records import CommandApplied, GuardChange

MS = 1_000_000
WANT = "command age 0.252 s above 0.250 s"


def flown(*causes: str) -> Recording:
    """A HOLD a second for each of these causes, its newest basis 252 ms old."""
    records: list[CommandApplied | GuardChange] = []
    for number, cause in enumerate(causes, 1):
        now_ns = number * 1000 * MS
        records.append(CommandApplied(now_ns - 100 * MS, 1, number, now_ns - 252 * MS, ZERO))
        records.append(GuardChange(now_ns, GuardState.HOLD, cause))
        records.append(GuardChange(now_ns + 50 * MS, GuardState.TRACK, "10 fresh commands"))
    return Recording.from_records(records, [])


def test_only_a_hold_for_want_of_commands_counts() -> None:
    recording = flown(WANT, "mission ended", WANT, "new session")
    assert holds(recording) == 2
    assert holds(recording, 0.5, 1.5) == 1
    assert age_at_hold(recording) == pytest.approx(0.252)


def test_a_hold_by_a_word_counts_apart() -> None:
    assert words(flown(WANT, "mission ended", "new session", "mission ended")) == 2
    assert words(flown(WANT)) == 0


def test_without_such_a_hold_there_is_no_age() -> None:
    for recording in (flown("mission ended"), flown()):
        assert (holds(recording), age_at_hold(recording)) == (0, 0.0)


@pytest.mark.parametrize(
    "text",
    [
        "nr_periods 51\nnr_throttled 44\nthrottled_time 903902617\n",
        "usage_usec 9\nnr_periods 51\nnr_throttled 44\nthrottled_usec 903902\n",
    ],
)
def test_both_versions_of_cgroups_tell_how_often_they_throttled(tmp_path: Path, text: str) -> None:
    (tmp_path / "cpu.stat").write_text(text)
    assert throttled(tmp_path) == 44
