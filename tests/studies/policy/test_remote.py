# SPDX-License-Identifier: Apache-2.0

"""A program outside controls the robot over a WebSocket, in lock step in virtual time."""

import json
from collections import Counter

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError, ControllerLostError
from cloudrc.cloud.controllers.remote import OutsideController
from cloudrc.config.load import load_experiment
from cloudrc.flight.experiment import check_mode
from cloudrc.flight.fly import fly
from cloudrc.flight.pod.openpi.codec import unpack
from cloudrc.flight.pod.realtime import free_ports
from cloudrc.flight.pod.transports import remote
from cloudrc.flight.virtual.flight import fly_virtual
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry, Setpoint
from cloudrc.wire.records import UNSENT
from tests.studies.policy.conftest import actions, after, serving, stock_like

SHORT = ("mission.waypoints=[{position_m: [0.5, 0, 0.7], dwell_s: 0.5}]", "mission.touch=null")
PID = """
from cloudrc.cloud.controllers.pid import build
from cloudrc.wire.messages import Odometry, Setpoint

controller = build()

def reset():
    controller.reset()

def infer(seen):
    turn, rate = tuple(seen["orientation_wxyz"]), tuple(seen["angular_velocity"])
    estimate = Odometry(
        seen["stamp_ns"], tuple(seen["position"]), turn, tuple(seen["velocity"]), rate
    )
    target = tuple(seen["setpoint/position"])
    setpoint = Setpoint(target, seen["setpoint/yaw"], velocity=tuple(seen["setpoint/velocity"]))
    output = controller.update(estimate, setpoint, seen["period_s"])
    return {"actions": [[*output.velocity, output.yaw_rate], [9, 9, 9, 9]]}
"""


def experiment(url, *settings):
    controller = json.dumps({"name": "remote", "url": url})
    return load_experiment("paper", [*SHORT, f"cloud.controller={controller}", *settings])


def true_path(flown):
    store = RecordStore()
    fly_virtual(flown, store.add)
    truth = Recording(records=store)["/ground_truth"]
    return np.column_stack((truth["stamp_ns"], truth["position"], truth["velocity"]))


def test_the_served_pid_flies_the_path_of_the_built_in_one_bit_by_bit(policy):
    with serving(policy(PID)) as url:
        served = true_path(experiment(url))
    assert np.array_equal(served, true_path(load_experiment("paper", SHORT)))
    assert len(served) > 100


def test_a_served_policy_that_returns_none_sends_nothing(policy):
    every_third = "    calls.append(0)\n    if len(calls) % 3:\n        return None\n    return {"
    often = "calls = []\n" + PID.replace("    return {", every_third)
    store = RecordStore()
    with serving(policy(often)) as url:
        fly_virtual(experiment(url), store.add)
    sent = Recording(records=store)["/delay_estimate"]["counter"]
    assert np.mean(sent == UNSENT) == pytest.approx(2 / 3, abs=0.01)


@pytest.mark.parametrize(
    ("last", "code", "text"),
    [
        (actions(np.nan), "controller_invalid", "not a finite number"),
        ("Traceback\nValueError: no", "controller_invalid", "ValueError: no"),
        (lambda link: link.close(1011), "controller_silent", "closed the connection"),
    ],
    ids=range(3),
)
def test_a_wrong_answer_in_flight_ends_it_with_one_line_and_a_recording(tmp_path, last, code, text):
    with (
        stock_like(after(20, last, actions(0.1))) as url,
        pytest.raises(ControllerLostError, match=rf"^[^\n]*{text}[^\n]*$") as lost,
    ):
        fly(experiment(url), "virtual", tmp_path, page=False)
    assert url in str(lost.value)
    assert (lost.value.code, lost.value.exit_code) == (code, 5)
    assert (tmp_path / "mission.mcap").stat().st_size > 1000
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["verdict"], report["failures"][0]["code"]) == ("failure", code)


def test_nobody_listening_ends_a_flight_before_it_begins(tmp_path):
    (port,) = free_ports(1)
    with pytest.raises(ControllerLostError, match="nobody listens") as raised:
        fly(experiment(f"ws://127.0.0.1:{port}"), "virtual", tmp_path, page=False)
    assert raised.value.code == "controller_silent"
    assert not (tmp_path / "report.json").exists()


def test_a_remote_controller_makes_no_plans_and_flies_here_only():
    with pytest.raises(BadInputError, match="cannot plan ahead"):
        experiment("ws://h:1", "cloud.plan_s=0.4", "cloud.predictor=kalman")
    with pytest.raises(BadInputError, match="on this machine only"):
        check_mode(experiment("ws://h:1"), "cluster")


class Peer:
    """A driver of a remote controller that answers as a test says."""

    def __init__(self):
        self.sent, self.arrived = [], []

    def send_data(self, data):
        self.sent.append(unpack(data))

    def receive_data(self):
        arrived, self.arrived = self.arrived, []
        return [remote.pack(each) for each in arrived]


class RealTime:
    """A remote controller in real time, on the clock of a test."""

    def __init__(self, monkeypatch, start_limit=60.0):
        self.now_ns, self.peer, self.counts = 10**9, Peer(), Counter()
        monkeypatch.setattr(remote.time, "monotonic_ns", lambda: self.now_ns)
        self.controller = OutsideController("ws://h:1", start_limit)
        link = remote.RemoteLink(self.peer, 0.01, start_limit)
        self.controller.connect(link, 0.01, self.counts)
        self.controller.reset()

    def answer(self, *xs, late=0, **more):
        """Answer the observation `late` before the newest with a row for each velocity in x."""
        asked = self.peer.sent[-1 - late]
        rows = {"rows": [[x, 0.0, 0.0, 0.0] for x in xs if x is not None]} if xs else {}
        head = {"episode": asked["episode"], "sent_ns": asked["sent_ns"]}
        self.peer.arrived.append({**head, **rows, **more})

    def step(self, count=1):
        """Take `count` periods; return the velocities along x."""
        found = []
        for _ in range(count):
            estimate = Odometry(self.now_ns, ZERO, UPRIGHT, ZERO, ZERO)
            output = self.controller.update(estimate, Setpoint(ZERO), 0.01)
            found.append(output and output.velocity[0])
            self.now_ns += 10_000_000
        return found

    def ends(self, count, code, text):
        """Check that the flight ends within `count` periods, and why."""
        with pytest.raises(ControllerLostError, match=text) as raised:
            self.step(count)
        assert raised.value.code == f"controller_{code}"


@pytest.fixture
def flight(monkeypatch):
    return RealTime(monkeypatch)


def test_in_real_time_each_row_of_an_answer_belongs_to_its_period(flight):
    assert flight.step() == [0.0]
    flight.answer(1.0, 2.0, 3.0, 4.0)
    assert flight.step(4) == [2.0, 3.0, 4.0, 4.0]


def test_in_real_time_the_newest_answer_wins(flight):
    flight.step(3)
    flight.answer(1.0)
    assert flight.step() == [1.0]
    flight.answer(7.0, late=3)
    assert flight.step() == [1.0]


def test_a_program_that_answers_nil_sends_nothing_and_is_not_silent(flight):
    flight.step()
    flight.answer(None)
    assert flight.step(2) == [None, None]
    flight.answer(7.0, late=1)  # both arrive in one period
    flight.answer(None)
    assert flight.step() == [7.0]
    flight.answer(3.0)
    flight.step()
    for _ in range(600):
        flight.answer(None)
        assert flight.step() == [None]
    assert not flight.counts["controller_gaps"]


def test_a_silent_program_freezes_the_reference_and_may_come_back(flight):
    flight.step()
    flight.answer(1.0)
    flown = flight.step(40)
    assert flown == [1.0] * 21 + [0.0] * 19  # one row and .2 s, from the time of its observation
    flight.step(440)
    flight.answer(2.0)
    assert flight.step(2) == [2.0, 2.0]
    assert flight.counts == {"controller_gaps": 1}


def test_a_program_silent_for_5_s_ends_the_flight_and_says_why(flight):
    flight.step()
    flight.answer(1.0)
    flight.step(22)
    flight.answer(trouble="ws://h:1: nobody listens there")
    flight.ends(510, "silent", "for 5 s: ws://h:1: nobody listens")


def test_answers_that_are_always_too_late_end_the_flight(flight):
    def answer_late():
        flight.answer(1.0, late=29)
        return flight.step()

    flight.step(30)
    with pytest.raises(ControllerLostError, match="too slow"):
        assert all(answer_late() == [0.0] for _ in range(600))


def test_the_first_answer_may_take_until_the_start_limit(monkeypatch):
    flight = RealTime(monkeypatch, start_limit=20.0)
    assert flight.step(1999) == [0.0] * 1999
    assert not flight.counts["controller_gaps"]
    flight.ends(3, "silent", "for 20 s")


def test_a_program_that_has_ended_before_its_first_answer_is_not_waited_for(flight):
    flight.peer.arrived.append({"ended": True})
    flight.step(40)
    flight.ends(20, "silent", r"for 0\.5 s")


def test_a_wrong_answer_in_real_time_ends_the_flight_at_once(flight):
    flight.step()
    flight.answer(invalid="ws://h:1: 'actions' has values that are not finite")
    flight.ends(1, "invalid", "not finite")


def test_a_pause_of_the_loop_is_no_silence_of_the_program(flight):
    flight.step()
    flight.answer(1.0)
    flight.step(3)
    flight.now_ns += 10**10
    assert flight.step() == [0.0]
    flight.answer(2.0)
    assert flight.step() == [2.0]
