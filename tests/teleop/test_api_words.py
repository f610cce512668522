"""What the API says of a wrong query or an empty mission: the words that fit, in one shape."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from collections.abc import Iterator

import pytest

from cloudrc.errors import BadInputError
from cloudrc.teleop import models
from tests.teleop.conftest import DIRECT, OPERATOR, Running, running


@pytest.fixture(scope="module")
def idle() -> Iterator[Running]:
    with running() as one:
        yield one


def asked(url: str) -> urllib.request.Request:
    return urllib.request.Request(url, headers={"Authorization": f"Bearer {OPERATOR}"})


@pytest.mark.parametrize("value", ["x", "1.5", ""])
def test_a_query_that_cannot_be_used_is_refused_like_a_body(idle: Running, value: str) -> None:
    with pytest.raises(urllib.error.HTTPError) as caught:
        DIRECT.open(asked(f"{idle.url}/v1/events?after={value}"), timeout=5.0)
    refusal = json.loads(caught.value.read())
    models.Refusal.model_validate(refusal)
    assert caught.value.code == 422
    (problem,) = refusal["problems"]
    assert (problem["path"], problem["value"], problem["index"]) == ("after", repr(value), None)
    assert "integer" in problem["reason"]
    assert refusal["detail"].startswith("after: ")


@pytest.mark.parametrize("key", ["name", "key"])
def test_a_text_that_is_too_long_is_told_how_long_it_may_be(idle: Running, key: str) -> None:
    waypoints = [{"position_m": [0.5, 0.0, 0.7]}]
    status, refusal = idle.post("/v1/missions", {key: "x" * 201, "waypoints": waypoints})
    (problem,) = refusal["problems"]
    assert (status, problem["path"]) == (422, key)
    assert problem["value"].startswith("'xxx")
    assert problem["reason"] == "must be text of at most 200 characters"


@pytest.mark.parametrize("key", ["name", "key"])
@pytest.mark.parametrize("sign", ["\x1b[2J", "\n", "\0", "\x7f", "\x9b", "\u2028", "\u202e"])
def test_a_text_that_would_steer_a_terminal_is_refused(idle: Running, key: str, sign: str) -> None:
    waypoints = [{"position_m": [0.5, 0.0, 0.7]}]
    before = idle.get("/v1/missions")
    status, refusal = idle.post("/v1/missions", {key: f"to {sign}", "waypoints": waypoints})
    models.Refusal.model_validate(refusal)
    assert status == 422
    assert refusal["detail"] == f"{key}: {f'to {sign}'!r}: must be one line of printable characters"
    (problem,) = refusal["problems"]
    assert (problem["path"], problem["reason"]) == (key, "must be one line of printable characters")
    assert refusal["detail"].isprintable()
    assert idle.get("/v1/missions") == before


def test_the_description_says_what_a_text_may_hold(idle: Running) -> None:
    post = idle.get("/openapi.json")["paths"]["/v1/missions"]["post"]
    texts = post["requestBody"]["content"]["application/json"]["schema"]["properties"]
    for key in ("name", "key"):
        assert texts[key]["maxLength"] == 200
        assert "printable" in texts[key]["description"]
    status, made = idle.post(
        "/v1/missions",
        {
            "name": "zum Brett, \N{RIGHTWARDS ARROW} 板",
            "waypoints": [{"position_m": [0.5, 0.0, 0.7]}],
        },
    )
    assert (status, made["name"]) == (201, "zum Brett, \N{RIGHTWARDS ARROW} 板")


@pytest.mark.parametrize("body", [{}, {"waypoints": []}, {"name": "nothing"}])
def test_nothing_is_offered_that_the_api_does_not_take(
    idle: Running, body: dict[str, object]
) -> None:
    status, refusal = idle.post("/v1/missions", body)
    assert status == 422
    assert refusal["detail"] == "waypoints: none given; give at least one"


@pytest.mark.parametrize("key", ["waypoints.0.dwell_s", "waypoints.0.time_limit_s", "time_limit_s"])
def test_no_time_is_so_long_that_a_limit_made_of_it_is_none(idle: Running, key: str) -> None:
    point = {"position_m": [0.5, 0.0, 0.7]}
    name = key.rpartition(".")[2]
    here = {"waypoints": [point | {name: 1e308}]} if "." in key else {name: 1e308}
    status, refusal = idle.post("/v1/missions", {"waypoints": [point]} | here)
    (problem,) = refusal["problems"]
    assert (status, problem["path"]) == (422, key)
    assert "and <= 1000000" in problem["reason"]


def test_what_the_plan_refuses_is_the_senders_fault(
    idle: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*args: object, **kwargs: object) -> None:
        raise BadInputError("time limit inf s: must be finite and above 0")

    monkeypatch.setattr("cloudrc.teleop.api.check_way", refuse)
    status, refusal = idle.post("/v1/goto", {"position_m": [0.5, 0.0, 0.7]})
    models.Refusal.model_validate(refusal)
    assert (status, refusal["detail"]) == (422, "time limit inf s: must be finite and above 0")
