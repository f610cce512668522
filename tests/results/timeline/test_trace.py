# SPDX-License-Identifier: Apache-2.0

"""The file of a timeline keeps the rules of its format, so that a viewer shows all of it."""

import json
from collections import defaultdict

import pytest

from cloudrc.results.timeline.loops import of_document, of_flight
from cloudrc.results.timeline.trace import LANES, write_trace
from tests.results.timeline.conftest import SETTINGS, flight_of


def ns(each, name="ts"):
    return round(each[name] * 1000)


def check_rules(events):
    """Check what Perfetto wants of a file; return its slices by process and track."""
    tracks, flows = defaultdict(list), defaultdict(list)
    last = {}
    for each in events:
        track = each["pid"], each["tid"]
        if each["ph"] == "M":
            continue
        assert ns(each) >= last.get(track, -(10**12)), "rising"
        last[track] = ns(each)
        if each["ph"] == "X":
            assert ns(each, "dur") > 0
            slices = tracks[track]
            assert not slices or ns(slices[-1]) + ns(slices[-1], "dur") <= ns(each), "overlap"
            slices.append(each)
        elif each["ph"] in "stf":
            flows[each["id"]].append(each)
    for flow in flows.values():
        flow.sort(key=lambda each: "stf".index(each["ph"]))
        assert [each["ph"] for each in flow] == ["s", *"t" * (len(flow) - 2), "f"]
        assert sorted(flow, key=ns) == flow
        for each in flow:
            slices = tracks[each["pid"], each["tid"]]
            assert any(ns(one) <= ns(each) < ns(one) + ns(one, "dur") for one in slices)
    named = {(each["pid"], each["tid"]) for each in events if each.get("name") == "thread_name"}
    assert set(last) <= named
    return tracks, flows


@pytest.mark.parametrize("settings", ["reordered", "blackouts", "computes"])
def test_the_file_keeps_the_rules_of_its_format(tmp_path, settings):
    loop = of_flight(flight_of(tmp_path, *SETTINGS[settings]))
    document = json.loads(write_trace({"loop": loop}, 0.0, 2.0))
    assert document["displayTimeUnit"] == "ms"
    _, flows = check_rules(document["traceEvents"])
    assert len(flows) > 100
    assert len({each["name"] for each in document["traceEvents"] if each["ph"] == "i"}) > 2
    later = json.loads(write_trace({"loop": loop}, 1.0, 1.5))["traceEvents"]
    check_rules(later)
    assert min(each["ts"] for each in later if each["ph"] in "stf") >= 1e6


def test_a_scan_has_slices_of_its_own_and_leads_to_its_command(tmp_path):
    settings = "cloud.perception_ms=70", *SETTINGS["constant"]
    loop = of_flight(flight_of(tmp_path, *settings, experiment="gap", lasts_s=4))
    events = json.loads(write_trace({"loop": loop}, 1.0, 2.0))["traceEvents"]
    _, flows = check_rules(events)
    name = next(each["name"] for each in events if each["name"].startswith("scan for"))
    slices = [each for each in events if each["name"] == name]
    assert [each["dur"] for each in slices] == [33_000, 70_000, 5_000]
    flow = next(each for each in flows.values() if each[0]["name"] == "scan")
    assert flow[0]["ts"] == slices[0]["ts"]
    assert flow[3]["ts"] == slices[2]["ts"] + 5_000
    command = name.removeprefix("scan for ")
    place = flow[3]["tid"], flow[3]["ts"]
    assert command in [each["name"] for each in events if (each["tid"], each.get("ts")) == place]


def test_slices_of_a_command_are_its_stages(tmp_path):
    loop = of_flight(flight_of(tmp_path, *SETTINGS["constant"]))
    events = json.loads(write_trace({"loop": loop}, 0.0, 1.0))["traceEvents"]
    counter = int(loop.budget.numbers[20]) & 0xFFFFFFFF
    lasts = [each["dur"] for each in events if each["name"] == f"#{counter}"]
    assert lasts == [33_000, 7_000, 21_000, 1_000, 10_000]


def test_slices_that_touch_share_a_track_and_slices_that_overlap_do_not():
    episode = {"stages": {"uplink": "to the cloud"}, "ticks": [1, 2, 3], "ended": [""] * 3}
    loop = of_document({**episode, "cuts_ns": [[0, 10, 15], [10, 20, 25]]})
    events = json.loads(write_trace({"loop": loop}, 0.0, 1.0))["traceEvents"]
    stage = [each for each in events if each["ph"] == "X" and each["tid"] < 2 * LANES]
    track_of = {each["name"]: each["tid"] for each in stage}
    assert track_of == {"#1": LANES, "#2": LANES, "#3": LANES + 1}
