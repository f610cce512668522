# SPDX-License-Identifier: Apache-2.0

"""The monitor of a link in flight, with simulated arrivals of the tunnel's datagrams."""

from math import nan

import pytest

from cloudrc.config.shipped import names
from cloudrc.link.verify.judge import netem_makes
from cloudrc.wire.records import Lateness, LinkChecked, Record
from tests.conftest import wait_until
from tests.doors.console.conftest import control
from tests.link.profiles import changed, profile_of
from tests.link.verify.conftest import arrivals, asked, checked, hearing, is_verified

PAPER = asked("paper-p2", "downlink")


@pytest.mark.parametrize(
    ("name", "netem"), [*((name, False) for name in names("profile")), ("lte", True)]
)
def test_an_honest_link_is_verified_and_never_faulted(name, netem):
    profile = asked(name, "uplink")
    seconds = 60.0 if netem or name == "handover" else 15.0
    made, seed = (netem_makes(profile), 3) if netem else (profile, 1)
    heard = arrivals(made, seconds, seed=seed, uplink=True)
    moments, faults = checked(hearing(profile, PAPER, uplink=True), heard)
    assert faults == []
    assert is_verified(moments[-1]), moments[-1]
    assert ("correlation" in moments[-1]) == (netem and profile.correlation > 0.0)
    assert ("rate" in moments[-1]) == (profile.rate_kbit is not None)
    assert ("time_line" in moments[-1]) == (name == "handover")
    assert ("radio" in moments[-1]) == ("mean" not in moments[-1]) == ("-sa" in name)


FAULTS = {
    "mean": changed(PAPER, delay_ms=PAPER.delay_ms * 1.1),
    "loss": changed(PAPER, loss=0.1),
}


@pytest.mark.parametrize("quantity", FAULTS)
def test_a_wrong_link_is_a_fault_after_a_second_look(quantity):
    moments, faults = checked(hearing(PAPER, PAPER), arrivals(FAULTS[quantity]))
    verdicts = [one[quantity].verdict for one in moments if quantity in one]
    assert verdicts[0] == "open", "not said before it was looked at again"
    assert verdicts[-1] == "off"
    assert [fault.code for fault in faults] == ["link"], "told once"
    assert faults[0].text.startswith("the downlink differs from its profile: ")


def test_without_a_common_clock_one_way_delays_are_not_judged():
    heard = arrivals(changed(FAULTS["mean"], loss=0.1), overhead=nan)
    moments, faults = checked(hearing(PAPER, PAPER), heard)
    assert moments[-1]["loss"].verdict == "off"
    assert not {"mean", "deviation"} & moments[-1].keys()
    assert len(faults) == 1


def test_late_wakes_of_the_ends_are_no_fault_of_the_link():
    slow = arrivals(changed(PAPER, delay_ms=PAPER.delay_ms + 4.5))
    assert checked(hearing(PAPER, PAPER), slow)[1], "of punctual ends it is"
    heard = []
    for arrival in slow:
        heard += [arrival, Lateness(arrival.stamp_ns, "world", 0.002, 0.0002, 0)]
    moments, faults = checked(hearing(PAPER, PAPER), heard)
    assert faults == []
    assert moments[-1]["mean"].verdict == "open"


@pytest.mark.parametrize(("slower", "verdict"), [(0.001, "ok"), (0.030, "off")])
def test_cloud_judges_round_trips_without_a_common_clock(slower, verdict):
    up, down = profile_of(0.040), profile_of(0.080)
    heard = []
    for arrival in arrivals(up, 15.0, overhead=nan, uplink=True):
        rtt = 0.120 + slower + arrival.counter * 1e-9
        heard += [arrival, control(arrival.stamp_ns * 1e-9, rtt=rtt)]
    moments, _ = checked(hearing(up, down, uplink=True), heard)
    trip = moments[-1]["round_trip"]
    assert (trip.asked, trip.verdict) == (pytest.approx(0.120, abs=1e-4), verdict)


def test_the_thread_judges_like_the_loop():
    monitor, heard, told = hearing(PAPER, PAPER), arrivals(PAPER, 12.0), list[Record]()
    monitor.begin((PAPER, PAPER))
    for one in heard:
        told += monitor.after([one], one.stamp_ns)
    wait_until(lambda: told or told.extend(monitor.after([], heard[-1].stamp_ns)), 20.0)
    assert {one.verdict for one in told if isinstance(one, LinkChecked)} == {"ok"}
