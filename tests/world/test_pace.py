"""A world that is slower than real time is reported with its factor, but not every second."""

from __future__ import annotations

import re

import pytest

from cloudrc.world.endpoint import REPORT_AGAIN_NS, PaceMonitor

SECOND_NS = 1_000_000_000


def told(*slips: float, start_ns: int = 0) -> list[tuple[int, str]]:
    """Return the reports of seconds in which world's clock slips by these times [s]."""
    pace, slip_ns, said = PaceMonitor(), 0, list[tuple[int, str]]()
    for n, slip in enumerate(slips):
        slip_ns += round(slip * 1e9)
        faults = pace.check(start_ns + (n + 1) * SECOND_NS, slip_ns)
        assert {fault.code for fault in faults} <= {"late"}
        said += [(n, fault.text) for fault in faults]
    return said


@pytest.mark.parametrize(
    ("slip", "words"),
    [
        (0.6129, "real-time factor 0.62 over 1.6 s: "),
        (0.18, "real-time factor 0.85 over 1.2 s: "),
        (4.9, "real-time factor 0.17 over 5.9 s: "),
        (0.053, "real-time factor 0.95 over 1.1 s: "),
    ],
)
@pytest.mark.parametrize("start_ns", [0, 10**15])
def test_a_slow_second_is_reported_with_its_factor(slip: float, words: str, start_ns: int) -> None:
    ((second, text),) = told(0.0, 0.0, slip, 0.0, start_ns=start_ns)
    assert second == 2
    assert text.startswith(words)
    assert text.endswith("give world more processor time")
    assert "\n" not in text


def test_real_time_and_the_first_call_report_nothing() -> None:
    assert told(3.0, 0.0, 0.05, 0.052, 0.0) == []


def test_a_world_that_is_always_slow_is_reported_once() -> None:
    assert [second for second, _ in told(0.0, *[0.5] * 100)] == [1]


def test_a_new_delay_after_10_s_of_real_time_is_reported() -> None:
    quiet = REPORT_AGAIN_NS // SECOND_NS
    soon, late = [0.0] * (quiet - 1), [0.0] * quiet
    assert [second for second, _ in told(0.0, 0.5, *soon, 0.5)] == [1]
    assert [second for second, _ in told(0.0, 0.5, *late, 0.7)] == [1, quiet + 2]


def test_the_second_report_has_the_factor_of_its_second() -> None:
    texts = [text for _, text in told(0.0, 0.5, *[0.0] * 10, 1.0)]
    assert [re.findall(r"\d\.\d\d", text) for text in texts] == [["0.67"], ["0.50"]]
