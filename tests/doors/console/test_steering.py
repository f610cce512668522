# SPDX-License-Identifier: Apache-2.0

"""What the operator asks for on the page reaches teleop and the link."""

import time

import pytest

from cloudrc.doors.console.steering import LinkControl, Steering
from cloudrc.wire.messages import ZERO
from tests.conftest import wait_until


@pytest.fixture
def steering(api, monkeypatch):
    """Steering whose thread, which nothing ends, looks at the state once and then sleeps."""
    monkeypatch.setattr("cloudrc.doors.console.steering.WATCH_PERIOD", 1e5)
    api.answers["/v1/state"] = {"mission": None}
    return Steering(api)


def test_held_keys_add_up_and_a_released_one_counts_no_more(steering):
    steering.hold_key("up", (0.0, 0.0, 0.4), 0.3)
    steering.hold_key("left", (0.0, 0.4, 0.0), 0.3)
    now = time.monotonic()
    assert steering.velocity(now) == (0.0, 0.4, 0.4)
    steering.release_keys("up")
    assert steering.velocity(now) == (0.0, 0.4, 0.0)
    assert steering.velocity(now + 0.3) == ZERO, "no sign of a held key"


def test_a_drive_ends_with_a_request_to_rest(api, steering):
    steering.start()
    steering.hold_key("turn", ZERO, 60.0, 0.3)
    wait_until(lambda: len(api.posted) > 3)
    steering.end_drive()
    turning = {"velocity_mps": ZERO, "yaw_rate_radps": 0.3}
    assert [body for _, body in api.posted[-2:]] == [turning, {"velocity_mps": ZERO}]


@pytest.mark.parametrize("loss", [0.02, {"good_to_bad": 0.1}])
def test_sliders_show_the_numbers_of_the_profile(api, loss):
    api.answers["/v1/state"] = {"mission": None}
    steering = Steering(api, LinkControl(lambda: {"uplink": {"delay_ms": 40, "loss": loss}}))
    steering.watch()
    assert steering.conditions["uplink.delay_ms"] == 40.0
    assert steering.conditions["downlink.jitter_ms"] == 0.0
    assert steering.conditions.get("uplink.loss") == (loss if loss == 0.02 else None)


def test_a_flying_mission_is_held_before_a_goto(api, steering):
    steering.state = {"mission": {"state": "flying"}}
    steering.go_to((0.5, 0.0, 1.2004))
    goto = ("/v1/goto", {"position_m": [0.5, 0.0, 1.2]})
    assert api.posted == [("/v1/hold", None), goto]
    api.posted.clear()
    steering.state = {"mission": None}
    steering.go_to((0.5, 0.0, 1.2))
    assert api.posted == [goto]


def test_a_stop_is_repeated_until_the_api_answers(api, steering):
    api.refused["/v1/estop"] = "teleop does not answer"
    steering.start()
    steering.stop()
    wait_until(lambda: len(api.posted) >= 3)
    api.refused.clear()
    wait_until(lambda: steering.answer.text == "switching the robot off")
    count = len(api.posted)
    time.sleep(0.3)  # longer than STOP_PERIOD
    assert len(api.posted) == count
    steering.end_drive()
