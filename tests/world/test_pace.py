"""A world that is slower than real time is reported with its factor, but not every second."""

import pytest

from cloudrc.world.endpoint import REPORT_AGAIN_NS, PaceMonitor

QUIET = REPORT_AGAIN_NS // 1_000_000_000


@pytest.mark.parametrize(
    ("slips", "reports"),
    [
        ((0.0, 0.0, 0.6129, 0.0), {2: "0.62 over 1.6 s"}),
        ((0.0, 0.053), {1: "0.95 over 1.1 s"}),
        ((3.0, 0.0, 0.05, 0.052, 0.0), {}),  # the first call reports nothing
        ((0.0, 0.5, *[0.0] * QUIET, 1.0), {1: "0.67 over 1.5 s", QUIET + 2: "0.50 over 2.0 s"}),
    ],
)
def test_seconds_in_which_the_clock_slips_are_reported(slips, reports):
    pace, slip_ns, said, start_ns = PaceMonitor(), 0, {}, 10**15
    for n, slip in enumerate(slips):
        slip_ns += round(slip * 1e9)
        for fault in pace.check(start_ns + (n + 1) * 1_000_000_000, slip_ns):
            assert fault.code == "late"
            assert fault.text.endswith("give world more processor time")
            said[n] = fault.text.removeprefix("real-time factor ").partition(": ")[0]
    assert said == reports
