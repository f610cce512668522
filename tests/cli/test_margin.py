"""`cloudrc margin`: the largest value of a key with which the flights of all seeds succeed."""

import json

import pytest

from cloudrc.cli.margin import largest_stable
from tests.cli.conftest import SHORT

KEY = "link.uplink.delay_ms"
FAILED = {"verdict": "failure", "failures": ["unstable"], "text": "the loop is unstable; lower it"}
UNSTABLE = "unstable, seed 1: the loop is unstable"


@pytest.fixture
def fly_with(replace_flights):
    """Replace flights: they succeed if `works(experiment)`."""

    def use(works):
        replace_flights(lambda found: {"verdict": "success"} if works(found) else FAILED)

    return use


@pytest.mark.parametrize("start", [1, 7, 64, 100])
@pytest.mark.parametrize("limit", [0, 1, 6, 7, 63, 64, 99])
def test_the_search_finds_each_border(start, limit):
    assert largest_stable(lambda step: step <= limit, start, 100) == (limit, limit + 1)
    assert largest_stable(lambda step: True, start, 100) == (100, 0)


@pytest.mark.parametrize(
    ("arguments", "works", "code", "answer"),
    [
        (KEY, lambda found: found.uplink.delay_ms <= 228 - 3 * (found.seed == 2), 0,
         "stable up to 220 ms (RTT 290 ms); fails at 230 ms (RTT 300 ms): unstable, seed 1"),
        (f"{KEY} --resolution 20", lambda found: found.uplink.delay_ms <= 228, 0,
         "stable up to 220 ms (RTT 290 ms); fails at 240 ms"),
        (f"{KEY} --max 80", lambda found: True, 0,
         "stable up to 80 ms (RTT 150 ms), the largest value tried; raise --max"),
        (f"{KEY} --max 80", lambda found: False, 1,
         f"no value is stable; fails at 10 ms (RTT 80 ms): {UNSTABLE}"),
        # The schema refuses a loss above 1.
        ("link.uplink.loss --resolution 0.3", lambda found: True, 0,
         "stable up to 0.9; fails at 1.2: refused: --set: link.uplink.loss"),
        # A large value is flown with all digits.
        ("link.uplink.rate_kbit --max 1234567 --resolution 1 --seeds 1",
         lambda found: found.uplink.rate_kbit <= 1234567, 0, "stable up to 1234567,"),
    ],
)  # fmt: skip
def test_the_last_line_names_the_border(arguments, works, code, answer, fly_with, call):
    fly_with(works)
    assert call(f"margin {arguments}", code=code).out.splitlines()[-1].startswith(answer)


def test_a_second_border_below_is_told(fly_with, call):
    fly_with(lambda found: found.uplink.delay_ms in (70, 140, 210, 200))
    found = json.loads(call(f"margin {KEY} -o json").out)
    assert (found["stable_up_to"], found["fails_at"], found["fails_below"]) == (210, 220, [150])


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


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ("link.uplink.delay", "unknown key; did you mean delay_ms"),
        ("seed", "seed: each flight has its own seed"),
        (f"{KEY} --set seed=2", "seed: each flight has its own seed"),
        ("link.profile", "is no number; name a key such as"),
        (f"{KEY} --max 5", "--resolution 10 must be above 0, --max 5 not below it"),
        *((f"{KEY} --resolution {text}", f"--resolution {text} must") for text in ("-1", "nan")),
        *((f"{KEY} --max {text}", f"--max {text} not") for text in ("nan", "0")),
    ],
)
def test_a_search_that_cannot_begin_is_refused(arguments, text, refused):
    assert text in refused(f"margin {arguments}")


def test_a_short_flight_has_a_margin(call):
    """One second of flight with the settling judged: no delay lets the robot arrive."""
    out = call(f"margin {KEY} -o json --seeds 1 --max 80", *SHORT[:2], code=1).out
    assert json.loads(out)["trials"][0]["code"] == "not_settled"
