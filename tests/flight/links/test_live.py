# SPDX-License-Identifier: Apache-2.0

"""A link whose profile changes while it runs says which direction has changed."""

import contextlib
import time
from types import SimpleNamespace

import pytest

from cloudrc.flight.links.carrier import CarrySettings, LiveLink
from cloudrc.flight.links.change import set_here


@pytest.mark.parametrize(("start", "note"), [("12", "the schedule begins at 12 s"), ("0", "")])
def test_a_link_that_comes_up_tells_where_its_schedule_begins(start, note):
    told = []
    with contextlib.ExitStack() as stack:
        asked = CarrySettings("handover", [f"start_s={start}"], 1)
        live = LiveLink(asked, "a test", told.append, stack)
        before_ns = time.monotonic_ns()
        live.carry(dict.fromkeys(["uplink", "downlink"]))
        origin_ns = live.origins_ns["downlink"]
    assert told == [note] * bool(note)
    assert origin_ns == live.origins_ns["uplink"]
    assert 0 <= origin_ns + float(start) * 1e9 - before_ns < 10e9


@pytest.mark.parametrize(
    ("profile", "settings", "changed"),
    [
        (None, ["uplink.delay_ms=300"], ["uplink"]),
        (None, ["uplink.delay_ms=30"], []),  # as before
        ("lte", [], ["uplink", "downlink"]),  # the schedules begin again
    ],
)
def test_a_change_is_told_for_the_directions_that_it_changes(profile, settings, changed):
    told = []
    with contextlib.ExitStack() as stack:
        live = LiveLink(CarrySettings("lte", [], 1), "a test", told.append, stack)
        live.carry(dict.fromkeys(["uplink", "downlink"]))
        at_once = SimpleNamespace(append=lambda change: change())
        live.serve(SimpleNamespace(changes=at_once))
        edit, states = set_here(live.folder, live.url, profile, settings, "1")
    assert [state.changes for state in states] == [1, 1]
    assert told == [f"the {way} has changed: {edit.cause}" for way in changed]
