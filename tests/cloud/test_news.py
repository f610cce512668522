# SPDX-License-Identifier: Apache-2.0

"""Send-on-delta: which commands cloud sends, and who hears of the others."""

import pytest

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.news import SendOnDelta
from cloudrc.cloud.predictors import Model
from cloudrc.cloud.predictors.last_sample import LastSample
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry
from cloudrc.wire.records import UNSENT
from tests.cloud.conftest import MS, command, loop, planned, telemetry
from tests.flights.conftest import both_ways, fly, numbers

TRACK, HOLD = GuardState.TRACK, GuardState.HOLD


RISING = [0.1 * k for k in range(9)]
NEXT = planned(10, *RISING[1:], 0.8)
"""What the plan `RISING` has from 10 ms on, and one velocity more."""


@pytest.mark.parametrize(
    ("second", "guard", "is_news"),
    [
        (NEXT, TRACK, False),
        (planned(10, *RISING), TRACK, True),  # the same velocities, but 10 ms later
        (planned(10, *(x + 0.049 for x in RISING[1:]), 0.8), TRACK, False),
        (planned(10, *(x + 0.051 for x in RISING[1:]), 0.8), TRACK, True),
        (planned(10, *RISING[1:5], *[9.0] * 5), TRACK, True),
        (planned(10, *RISING[1:6], *[9.0] * 4), TRACK, False),  # after the next beat
        (NEXT._replace(yaw_rate=0.1), TRACK, True),
        (NEXT._replace(plan=()), TRACK, True),
        (NEXT, HOLD, True),
        (NEXT, GuardState.GROUND, False),
        (planned(29, *RISING[2:], 0.8, 0.8), TRACK, False),
        (planned(30, *RISING[3:], 0.8, 0.8, 0.8), TRACK, True),  # the beat
    ],
)
def test_news_is_what_differs_from_the_last_plan_before_the_next_beat(second, guard, is_news):
    news = SendOnDelta(0.05, 0.03)
    assert news.has(planned(0, *RISING), TRACK)
    assert news.has(second, guard) == is_news


def test_a_command_is_compared_with_the_last_one_that_was_sent():
    news = SendOnDelta(0.05, 0.5)
    creeping = [news.has(planned(10 * k, *[0.02 * k] * 80), TRACK) for k in range(7)]
    assert creeping == [True, False, False, True, False, False, True]


class Still(Model):
    def step(self, velocity, dt):
        return Odometry(0, ZERO, UPRIGHT, ZERO, ZERO)


class Listening(LastSample):
    def __init__(self):
        self.heard = []

    def commanded(self, command):
        self.heard.append(command.stamp_ns // MS)

    def model(self):
        return Still()


class Saying(Controller):
    """Commands one velocity after the other, then the last one for ever."""

    def __init__(self, *xs):
        self.xs = list(xs)

    def update(self, estimate, setpoint, dt):
        x = self.xs.pop(0) if len(self.xs) > 1 else self.xs[0]
        return None if x is None else ControlOutput((x, 0.0, 0.0), 0.0)


def test_the_predictor_does_not_hear_of_a_command_that_is_withheld():
    predictor = Listening()
    news = SendOnDelta(0.05, 0.04)
    a_loop = loop(None, predictor, Saying(1.0), heard_ms=1000, plan=0.16, news=news)
    made = [command(a_loop, 1000 + 10 * k) for k in range(10)]
    sent = [None if each is None else each.stamp_ns // MS for each, _ in made]
    assert sent == [1000, *[None] * 3, 1040, *[None] * 3, 1080, None]
    assert predictor.heard == [1000, 1040, 1080]
    assert [control.counter == UNSENT for _, control in made] == [each is None for each in sent]
    assert a_loop.counts["commands_withheld"] == 7
    a_loop.observe(telemetry(200)._replace(guard=HOLD), 1100 * MS)
    assert all(command(a_loop, 1100 + 10 * k)[0] for k in range(3))


def test_a_controller_that_returns_none_sends_nothing():
    predictor = Listening()
    a_loop = loop(None, predictor, Saying(None, 1.0, None), heard_ms=1000, plan=0.02)
    nothing, sent, silent = (command(a_loop, 1000 + 10 * k) for k in range(3))
    assert (nothing[0], nothing[1].command) == (None, ZERO)
    assert sent[0].plan == ((1.0, 0.0, 0.0),) * 2, "its plan goes on with the last velocity"
    assert (silent[0], silent[1].command) == (None, (1.0, 0.0, 0.0))
    assert predictor.heard == [1010]
    assert a_loop.counts == {"commands_withheld": 2}


def test_a_loop_freezes_for_want_of_an_echo_only_if_a_command_waits_for_one():
    a_loop = loop(None, Listening(), Saying(1.0, *[None] * 99, 2.0), heard_ms=1000)
    command(a_loop, 1000)
    a_loop.observe(telemetry(110, echo_ms=1000), 1010 * MS)
    assert {command(a_loop, 1000 + 10 * k)[0] for k in range(1, 100)} == {None}
    again = [command(a_loop, 2000 + 10 * k)[0] for k in range(60)]
    assert {each.velocity[0] for each in again[:40]} == {2.0}
    assert again[-1].velocity == ZERO


FAR = ["link.profile=ideal", *both_ways(delay_ms=200, loss=0.1)]
SHORT = ["mission=steps", "world.scene=empty", "mission.touch=null", "mission.steps.count=1"]


def compare(plan_s, *settings):
    """Fly with all commands, and with those that are news; return numbers of both."""
    on_delta = "cloud.send_delta_mps=0.05", f"cloud.plan_s={plan_s}"
    flown = [fly("fast", *FAR, *settings, *more) for more in ((), on_delta)]
    assert [flight.verdict.failures for flight in flown] == [(), ()]
    return [numbers(flight) for flight in flown]


def test_sent_on_delta_a_mission_needs_a_fraction_of_the_bytes():
    every, news = compare(0.4, *SHORT)
    assert news["bytes_sent_downlink"] < every["bytes_sent_downlink"] / 3
    assert news["hold_count"] == 0
    assert "commands_withheld" not in every
    sent = news["packets_sent_downlink"]
    assert news["commands_withheld"] + sent == pytest.approx(
        every["packets_sent_downlink"], rel=0.1
    )
    assert news["loss_downlink"] == pytest.approx(0.1, abs=0.08)
    assert news["tracking_rms_estimated"] < every["tracking_rms_estimated"] + 0.007


@pytest.mark.full
@pytest.mark.parametrize("seed", range(1, 11))
@pytest.mark.parametrize("plan_s", [0.4, 0.8])
def test_sent_on_delta_the_contact_comes_in_time_for_an_eighth_of_the_bytes(plan_s, seed):
    every, news = compare(plan_s, f"seed={seed}")
    assert news["bytes_sent_downlink"] <= every["bytes_sent_downlink"] / 8
    assert news["contact_time"] == pytest.approx(every["contact_time"], rel=0.01)
    assert news["hold_count"] == 0
