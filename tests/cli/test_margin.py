"""`cloudrc margin`: the largest value of a key with which the flights of all seeds succeed."""

import json

import pytest

from cloudrc.cli.main import main
from cloudrc.cli.margin import largest_stable

KEY = "link.uplink.delay_ms"
TEXT = "the loop is unstable; lower the gains"
FAILED = {"verdict": "failure", "failures": ["unstable"], "text": TEXT}


def fly_with(monkeypatch, works):
    """Replace flights by `works(experiment, seed)`."""

    def fly(experiment):
        return {"verdict": "success"} if works(experiment, experiment.seed) else FAILED

    monkeypatch.setattr("cloudrc.sweep.flight.fly_point", fly)
    monkeypatch.setattr("cloudrc.cli.pool.usable_cores", lambda: 1)


def margin(capsys, *arguments):
    """Return exit code and document of `cloudrc margin link.uplink.delay_ms`."""
    code = main(["margin", KEY, "-o", "json", *arguments])
    return code, json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("start", [1, 7, 64, 100])
@pytest.mark.parametrize("limit", [0, 1, 6, 7, 63, 64, 99])
def test_the_search_finds_each_border(start, limit):
    assert largest_stable(lambda step: step <= limit, start, 100) == (limit, limit + 1)
    assert largest_stable(lambda step: True, start, 100) == (100, 0)


def test_the_border_is_a_multiple_of_the_resolution(monkeypatch, capsys):
    fly_with(monkeypatch, lambda found, seed: found.uplink.delay_ms <= 228 - 3 * (seed == 2))
    code, found = margin(capsys, "--resolution", "20")
    assert (code, found["stable_up_to"], found["fails_at"]) == (0, 220, 240)
    assert main(["margin", KEY]) == 0
    line = "stable up to 220 ms (RTT 290 ms); fails at 230 ms (RTT 300 ms): unstable, seed 1: "
    assert capsys.readouterr().out.splitlines()[-1] == line + "the loop is unstable"


def test_the_limits_of_cloud_and_guard_follow_the_delay(monkeypatch, capsys):
    """The mean age is the round trip and one or two periods; --set has the last word."""
    seen = {}
    fly_with(monkeypatch, lambda found, seed: seen.update({found.uplink.delay_ms: found}) or True)
    margin(capsys, "--max", "2000", "--set", "cloud.freeze_after_s=0.7", "--seeds", "1")
    limits = seen[2000]
    assert 2.2 <= limits.cloud.horizon_max_s <= 2.4
    assert 2200 <= limits.guard.command_age_max_ms <= 2400
    assert limits.cloud.freeze_after_s == 0.7
    assert seen[70].guard.command_age_max_ms == 400


def test_a_second_border_below_is_told(monkeypatch, capsys):
    fly_with(monkeypatch, lambda found, seed: found.uplink.delay_ms in (70, 140, 210, 200))
    code, found = margin(capsys)
    assert (code, found["stable_up_to"], found["fails_below"]) == (0, 210, [150])


def test_a_large_value_is_flown_with_all_digits(monkeypatch, capsys):
    flown = set()
    fly_with(monkeypatch, lambda found, seed: flown.add(found.uplink.rate_kbit) or True)
    line = ["--max", "1234567", "--resolution", "1", "--seeds", "1"]
    assert main(["margin", "link.uplink.rate_kbit", *line]) == 0
    assert 1234567 in flown
    assert "stable up to 1234567," in capsys.readouterr().out


@pytest.mark.parametrize(
    ("works", "code", "text"),
    [(True, 0, "80 ms (RTT 150 ms), the largest value tried; raise --max"),
     (False, 1, "no value is stable; fails at 10 ms (RTT 80 ms): unstable, seed 1")],
)  # fmt: skip
def test_a_search_without_a_border_says_so(works, code, text, monkeypatch, capsys):
    fly_with(monkeypatch, lambda found, seed: works)
    assert main(["margin", KEY, "--max", "80"]) == code
    assert text in capsys.readouterr().out.splitlines()[-1]


def test_a_value_that_the_schema_refuses_is_a_border(monkeypatch, capsys):
    fly_with(monkeypatch, lambda found, seed: True)
    assert main(["margin", "link.uplink.loss", "--resolution", "0.3"]) == 0
    answer = capsys.readouterr().out.splitlines()[-1]
    assert answer.startswith("stable up to 0.9; fails at 1.2: refused: --set: link.uplink.loss")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["link.uplink.delay"], "unknown key; did you mean delay_ms"),
        (["link.profile"], "is no number; name a key such as"),
        ([KEY, "--max", "5"], "--resolution 10 must be above 0, --max 5 not below it"),
        ([KEY, "--resolution", "-1"], "--resolution -1 must be above 0"),
        *(([KEY, "--resolution", text], f"--resolution {text} must") for text in ("nan", "0")),
        *(([KEY, "--max", text], f"--max {text} not") for text in ("nan", "0")),
    ],
)
def test_a_search_that_cannot_begin_is_refused(arguments, text, capsys):
    assert main(["margin", *arguments]) == 2
    assert text in capsys.readouterr().err


def test_a_short_flight_has_a_margin(capsys):
    """One second of flight with the settling judged: no delay lets the robot arrive."""
    short = ["--set", "mission.steps.count=1", "--set", "mission.steps.period_s=1.0"]
    code, found = margin(capsys, "--seeds", "1", "--max", "80", *short)
    assert (code, found["trials"][0]["code"]) == (1, "not_settled")
