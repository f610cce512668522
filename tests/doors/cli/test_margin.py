# SPDX-License-Identifier: Apache-2.0

"""`cloudrc margin KEY`: the values with which the loop is stable, and with which it settles."""

import pytest

KEY = "link.uplink.delay_ms"
FAILED = {"verdict": "failure", "failures": ["not_settled"], "text": "it is late; lower it"}
GROWS = {"stable": False, "code": "unstable", "text": "z swings; lower it"}
LATE = "not_settled, seed 1: it is late"
UNSTABLE = "unstable, seed 1: z swings"


@pytest.fixture
def fly_with(replace_flights, monkeypatch):
    """Replace flights: they succeed if `works(experiment)`, and die out if `stable(experiment)`."""

    def use(works, stable=None):
        def fly_step(found, size=0.1):
            if not (stable or works)(found):
                return GROWS
            return {"stable": True, "left": 0.0, "speed_limited": 0.25 if size == 1.0 else 0.0}

        replace_flights(lambda found: {"verdict": "success"} if works(found) else FAILED)
        monkeypatch.setattr("cloudrc.studies.stability.fly_step", fly_step)

    return use


def uplink(limit):
    return lambda found: found.uplink.delay_ms <= limit


@pytest.mark.parametrize(
    ("arguments", "works", "code", "answer"),
    [
        (KEY, lambda found: found.uplink.delay_ms <= 228 - 3 * (found.seed == 2), 0,
         "settles up to 220 ms (RTT 290 ms); fails at 230 ms (RTT 300 ms): not_settled, seed 1:"),
        (f"{KEY} --max 80", lambda found: False, 1,
         f"no value settles; it fails at 10 ms (RTT 80 ms): {LATE}"),
        # The experiment allows no loss above 1: that is no failure of the loop.
        ("link.uplink.loss --resolution 0.3", lambda found: True, 0,
         "settles up to 0.9, the largest value possible: --set: link.uplink.loss: 1.2:"),
        # The stable side is above.
        ("guard.command_age_max_ms --max 500",
         lambda found: found.guard.command_age_max_ms > 117, 0,
         f"settles from 120 ms up to 500 ms, the largest value tried; raise --max; "
         f"fails at 110 ms: {LATE}"),
    ],
)  # fmt: skip
def test_the_last_line_names_the_border(arguments, works, code, answer, fly_with, call):
    fly_with(works)
    assert call(f"margin {arguments}", code=code).out.splitlines()[-1].startswith(answer)


def test_stability_and_settling_are_two_answers(fly_with, call, as_json):
    fly_with(uplink(150), stable=uplink(400))
    lines = call(f"margin {KEY}").out.splitlines()[-3:]
    border = f"fails at 410 ms (RTT 480 ms): {UNSTABLE}"
    assert lines[0] == f"stable up to 400 ms (RTT 470 ms); {border}"
    assert lines[1].startswith("with this value a step of 1 m per axis dies out, too;")
    assert lines[1].endswith("m/s shortens 25.0% of the commands")
    assert lines[2].startswith("settles up to 150 ms")
    found = as_json(f"margin {KEY}")
    assert (found["stable_up_to"], found["settles_up_to"]) == (400, 150)
    assert (found["large_step"]["stable"], found["large_step"]["speed_limited"]) == (True, 0.25)


def test_an_island_above_a_failing_value_is_told(fly_with, call, as_json):
    fly_with(uplink(9999), stable=lambda found: not 100 <= found.uplink.delay_ms < 500)
    found = as_json(f"margin {KEY}")
    assert (found["stable_up_to"], found["stable_fails_at"]) == (90, 100)
    assert found["stable_elsewhere"] == [[560, 2240]]
    stable = call(f"margin {KEY}").out.splitlines()[-3]
    assert stable.endswith("; beyond values that fail, 560 ms (RTT 630 ms) to 2240 ms "
                           "(RTT 2310 ms) is stable, too")  # fmt: skip


def test_the_limits_of_cloud_and_guard_follow_the_delay(fly_with, call):
    """The mean age is the round trip and one or two periods; --set has the last word."""
    seen = {}
    fly_with(lambda found: seen.update({found.uplink.delay_ms: found}) or True)
    call(f"margin {KEY} --max 2000 --set cloud.freeze_after_s=0.7 --seeds 1")
    limits = seen[2000]
    assert 2.2 <= limits.cloud.horizon_max_s <= 2.4
    assert 2200 <= limits.guard.command_age_max_ms <= 2400
    assert limits.cloud.freeze_after_s == 0.7
    assert seen[70].guard.command_age_max_ms == 400
