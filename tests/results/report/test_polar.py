# SPDX-License-Identifier: Apache-2.0

"""The polar picture has the scans of the flight, their setpoints and when the robot acted."""

import json
import re

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.flight.virtual.flight import fly_virtual
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.report.flown import flight_of
from cloudrc.results.report.polar import write_polar
from cloudrc.results.report.views import views

SHORT = ["mission.waypoints=[{position_m: [1.5, 0], tolerance_m: 0.5}]", "link.both.delay_ms=20"]


@pytest.fixture(scope="module")
def flown():
    experiment, store = load_experiment("gap", SHORT), RecordStore()
    fly_virtual(experiment, store.add)
    return experiment, Recording(records=store)


def test_each_scan_has_its_time_its_distances_its_setpoint_and_its_age(flown):
    experiment, recording = flown
    flight = flight_of(recording, experiment)
    page = write_polar(flight)
    data = json.loads(re.search('id="seen">(.*?)</script>', page)[1])
    scans, rows = data["scans"], flight.during("/scan")
    assert [scan["time"] for scan in scans] == pytest.approx(
        flight.seconds(rows["stamp_ns"]), abs=1e-3
    )
    assert len(data["angles"]) == len(scans[0]["ranges"]) == 181
    seen = np.isfinite(rows["ranges"][3])
    assert np.array(scans[3]["ranges"])[seen] / 1e3 == pytest.approx(rows["ranges"][3][seen])
    assert not np.array(scans[3]["ranges"])[~seen].any()
    acted = [scan for scan in scans if scan["age"] is not None]
    assert len(acted) > len(scans) - 3, "of the last scans nothing may follow"
    for scan in acted:
        assert 40 <= scan["age"] <= 60, "both ways, and the wait for the next command"
        assert np.hypot(*scan["goal"]) == pytest.approx(2.0, abs=0.02)


def test_a_flight_without_scans_has_no_such_picture(flown):
    experiment, _ = flown
    empty = Recording.from_records(())
    assert write_polar(flight_of(empty, experiment)) == ""


def test_foxglove_gets_the_frame_of_the_scanner(flown):
    experiment, recording = flown
    frames = [each for each in views(recording, experiment) if each[0] == "/tf"]
    stamps = {*recording["/scan"]["stamp_ns"].tolist()}
    assert sum(b"lidar" in data and stamp in stamps for _, stamp, data in frames) == len(stamps)
