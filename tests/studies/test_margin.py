# SPDX-License-Identifier: Apache-2.0

"""What a search for a margin tells about the values that it tries."""

from cloudrc.studies.margin import Asked, Margin


def test_a_round_trip_is_told_only_if_it_is_constant(tmp_path):
    trace = tmp_path / "trace.csv"
    trace.write_text("time_s,delay_ms\n0,300\n")
    constant = Margin(Asked("link.downlink.delay_ms", "steps", [], 1, max=40))
    assert constant.name(2) == "20 ms (RTT 90 ms)"
    for changing in (f"link.uplink.trace={trace}", "link.profile=handover"):
        changing_link = Margin(Asked("link.downlink.delay_ms", "steps", [changing], 1, max=40))
        assert changing_link.name(2) == "20 ms"
