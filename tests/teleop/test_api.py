"""The API over HTTP, as its clients meet it."""

import json
import threading
import time
import urllib.error
import urllib.request
from collections import deque

import pytest

from cloudrc.cli.teleop import ServedApi
from cloudrc.config.load import load_mission
from cloudrc.errors import BadInputError
from cloudrc.exposition.live import LiveMetrics
from cloudrc.teleop import models
from cloudrc.teleop.server import ApiServer
from tests.teleop.conftest import DIRECT, A, B, C, running

LEG = {"dwell_s": 0.0, "tolerance_m": 0.3}
MISSION = {"name": "round", "waypoints": [{"position_m": p, **LEG} for p in (A, B, C)]}
A_MISSION = {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}


@pytest.fixture
def api():
    with running() as one:
        yield one


@pytest.fixture(scope="module")
def idle():
    """One that flies nothing."""
    with running() as one:
        yield one


def fly(api, mission=MISSION):
    _, view = api.post("/v1/missions", mission)
    api.until(lambda: api.state_of(view["id"]) == "flying")
    return view["id"]


def finish(api, mission_id):
    for count, point in enumerate((A, B, C), 1):
        api.flight.position = point
        path = f"/v1/missions/{mission_id}"
        api.until(lambda count=count, path=path: len(api.get(path)["reached"]) >= count)
    api.until(lambda: api.state_of(mission_id) == "done")


def test_a_mission_from_post_to_verdict(api):
    status, view = api.post("/v1/missions", {**MISSION, "key": "uid"})
    assert status == 201
    models.MissionView.model_validate(view)
    assert (view["id"], view["state"], view["waypoints"]) == ("m1", "starting", 3)
    api.until(lambda: api.state_of("m1") == "flying")
    finish(api, "m1")
    view = api.get("/v1/missions/m1")
    models.MissionView.model_validate(view)
    assert view["verdict"] == {"outcome": "success", "exit_code": 0, "failures": []}
    listed = api.get("/v1/missions")
    models.MissionList.model_validate(listed)
    assert [mission["id"] for mission in listed["missions"]] == ["m1"]
    status, again = api.post("/v1/missions", {**MISSION, "key": "uid"})
    assert (status, again["id"]) == (200, "m1")


def test_a_second_one_is_refused_with_the_id_of_the_first(api):
    mission_id = fly(api)
    status, refusal = api.post("/v1/missions", MISSION)
    assert (status, refusal["id"]) == (409, mission_id)
    assert mission_id in refusal["detail"]
    status, queued = api.post("/v1/missions", {**MISSION, "queue": True})
    assert (status, queued["state"]) == (201, "queued")
    status, ended = api.post(f"/v1/missions/{queued['id']}/cancel")
    assert (status, ended["verdict"]["exit_code"]) == (200, 130)


def test_refusals_and_missed_events_are_counted_in_metrics(api, monkeypatch):
    served, live = ServedApi(api.bridge, api.server, api.audit), LiveMetrics("teleop")
    served.open(api.flight.teleop, lambda: None)
    fly(api)
    far = {"position_m": [100.0, 0.0, 1.0]}
    refused = [("/v1/missions", {"waypoints": [far]}), ("/v1/goto", far), ("/v1/missions", b"{")]
    assert [api.post(*order)[0] for order in refused] == [422, 422, 422]
    assert api.post("/v1/missions", MISSION)[0] == 409
    assert api.post("/v1/acknowledge")[0] == 409, "a state that does not allow it is no order"
    book = api.flight.teleop.book
    log = deque(book.events_after(0), maxlen=2)
    log.extend({"id": number} for number in range(10, 14))
    monkeypatch.setattr(book, "_log", log)
    book.events_after(0)  # whoever is new has missed nothing
    monkeypatch.setattr(book, "_events", 13)
    assert [event["id"] for event in book.events_after(12)] == [13]  # who reads along hides none
    for _ in range(2):  # asking again and again raises no alarm
        assert [event["id"] for event in book.events_after(8)] == [12, 13]
    live.see(served.counted())
    readings = live.read()
    counts = {("invalid",): 3, ("conflict",): 1}
    assert readings["cloudrc_missions_refused_total"] == counts
    assert readings["cloudrc_stream_dropped_events_total"] == {(): 3}


def test_the_operators_hand(api):
    assert api.post("/v1/resume")[0] == 409
    mission_id = fly(api)
    status, refusal = api.post("/v1/goto", {"position_m": [0.5, 0.0, 1.0]})
    assert (status, refusal["id"]) == (409, mission_id)
    assert api.post("/v1/hold")[1]["state"] == "held"
    assert api.post("/v1/goto", {"position_m": [0.5, 0.0, 1.0]})[0] == 200
    assert api.post("/v1/resume")[1]["state"] == "flying"
    assert api.post(f"/v1/missions/{mission_id}/cancel")[1]["state"] == "cancelled"
    assert api.post(f"/v1/missions/{mission_id}/cancel")[0] == 409
    assert api.post("/v1/missions/m99/cancel")[0] == 404


def test_the_state_is_told_and_unknown_numbers_are_null(idle):
    idle.until(lambda: idle.get("/v1/state")["seen"] is not None)
    state = idle.get("/v1/state")
    models.StateView.model_validate(state)
    assert state["mission"] is None
    assert state["cloud_age_s"] >= 0.0
    assert state["seen"]["guard"] == "GROUND"
    assert state["seen"]["rtt_s"] is None
    assert state["seen"]["guard_for_s"] >= 0.0
    assert "waits for a mission" in state["seen"]["next_step"]


@pytest.mark.promise("bad-missions-are-refused")
@pytest.mark.parametrize(
    ("body", "path", "index", "words"),
    [
        ({"waypoints": [A_MISSION["waypoints"][0], {"position_m": [99, 0, 1]}]},
         "waypoints.1.position_m", 1, "beyond the fence"),
        ({"waypoints": [{"position_m": [-0.5, 2.0, 0.8]}]},
         "waypoints.0.position_m", 0, "wall of pipe"),
        ({"waypoints": [{"position_m": [0, 0]}]}, "waypoints.0.position_m.2", 0, "is missing"),
        ({"waypoints": [{"position_m": [0, 0, "high"]}]},
         "waypoints.0.position_m.2", 0, "must be a number [m]"),
        ({"waypoints": [{"position_m": [0, 0, 1], "dwell": 1}]},
         "waypoints.0.dwell", 0, "did you mean dwell_s"),
        ({"waypoints": [{"position_m": [0, 0, 1], "tolerance_m": 0}]},
         "waypoints.0.tolerance_m", 0, "> 0"),
        ({"waypoints": []}, "waypoints", None, "at least one"),
        ({**A_MISSION, "time_limit_s": -1}, "time_limit_s", None, "> 0"),
        ({**A_MISSION, "start": "there"}, "start", None, "'spawn' or 'here'"),
        ({**A_MISSION, "key": "k" * 300}, "key", None, ""),
        ({"waypoints": [{"position_m": [0, 0, 1]}] * 6000 + [{}]},
         "waypoints.6000.position_m", 6000, "is missing"),
        (b'{"waypoints": [{"position_m": [0, 0, NaN]}]}',
         "waypoints.0.position_m.2", 0, "finite"),
        (b"nonsense", "", None, "not JSON"),
        (b"", "", None, "not JSON"),
        (b"[]", "", None, "mapping"),
    ],
)  # fmt: skip
def test_a_value_that_cannot_be_used_is_named(idle, body, path, index, words):
    status, refusal = idle.post("/v1/missions", body)
    models.Refusal.model_validate(refusal)
    assert status == 422
    problem = next(p for p in refusal["problems"] if p["path"] == path)
    assert problem["index"] == index
    assert words in problem["reason"]
    assert path in refusal["detail"] or len(refusal["problems"]) > 3
    assert idle.get("/v1/missions")["missions"] == []


def test_a_superscript_digit_as_key_is_refused(idle):
    """Superscripts are digits to `str.isdigit`, and `int` reads none of them."""
    status, refusal = idle.post("/v1/missions", {"waypoints": [], "\u00b3": 1})
    assert status == 422
    assert {"\u00b3", "waypoints"} >= {problem["path"] for problem in refusal["problems"]}


def test_a_point_is_checked_like_a_waypoint(idle):
    status, refusal = idle.post("/v1/goto", {"position_m": [0, 0, 99]})
    assert status == 422
    assert refusal["problems"][0]["path"] == "position_m"


def test_a_body_that_is_too_long_is_not_read_on(idle):
    status, refusal = idle.post("/v1/missions", b" " * (256 * 1024 + 1))
    assert (status, "256 KiB" in refusal["detail"]) == (413, True)


def test_only_a_mission_to_the_board_must_touch_it(api):
    api.post("/v1/missions", A_MISSION)
    assert not api.flight.teleop.book.find("m1").order.contact
    api.post("/v1/missions/m1/cancel")
    points = [{"position_m": point.position_m} for point in load_mission("pipes").waypoints]
    api.post("/v1/missions", {"waypoints": points})
    assert api.flight.teleop.book.find("m2").order.contact


def test_until_the_journal_is_free_it_is_unavailable():
    with running(ready=False) as api:
        api.bridge.closed = "another teleop has this journal open"
        for call in (lambda: api.post("/v1/missions", A_MISSION), lambda: api.post("/v1/hold")):
            status, refusal = call()
            assert (status, refusal["detail"]) == (503, "another teleop has this journal open")
        with pytest.raises(urllib.error.HTTPError, match="503"):
            api.get("/v1/state")


def read_events(api, count, headers=None, path="/v1/events"):
    request = api.request(path, headers=headers)
    events, numbers = [], []
    with DIRECT.open(request, timeout=5.0) as stream:
        for line in stream:
            key, _, value = line.decode().strip().partition(": ")
            if key == "id":
                numbers.append(int(value))
            elif key == "data":
                events.append(json.loads(value))
            if len(events) == count:
                return numbers, events
    raise AssertionError("the stream ended")


def test_events_are_streamed_and_resumed_where_one_left(api):
    finish(api, fly(api))
    numbers, events = read_events(api, 6)
    for event in events:
        models.Event.model_validate(event)
    assert numbers == [event["id"] for event in events] == [1, 2, 3, 4, 5, 6]
    assert [event["event"] for event in events[:2]] == ["starting", "started"]
    assert read_events(api, 2, {"Last-Event-ID": "4"})[0] == [5, 6]
    assert read_events(api, 1, path="/v1/events?after=5")[0] == [6]
    assert read_events(api, 1, {"Last-Event-ID": "rubbish"})[0] == [1]
    assert read_events(api, 1, {"Last-Event-ID": "999"})[0] == [1]  # of a journal that is gone


def test_an_event_arrives_while_it_happens(api):
    arrived = []
    listener = threading.Thread(target=lambda: arrived.extend(read_events(api, 2)[1]))
    listener.start()
    api.post("/v1/missions", A_MISSION)
    listener.join(5.0)
    assert [event["event"] for event in arrived] == ["starting", "started"]


def test_an_open_stream_does_not_keep_the_server_from_ending():
    with running() as api:
        stream = DIRECT.open(api.request("/v1/events"), timeout=5.0)
        began = time.monotonic()
        api.stop()
        assert time.monotonic() - began < 1.5
        stream.close()


def test_a_taken_address_is_one_sentence(idle):
    port = int(idle.url.rpartition(":")[2])
    with pytest.raises(BadInputError, match=r"--api 127.0.0.1:\d+: Address already in use"):
        ApiServer(idle.gate, idle.bridge, ("127.0.0.1", port))


def test_the_openapi_document_describes_everything(idle):
    document = idle.get("/openapi.json")
    assert document["info"]["title"] == "cloudrc teleop"
    post = document["paths"]["/v1/missions"]["post"]
    content = post["requestBody"]["content"]["application/json"]
    models.MissionRequest.model_validate_json(json.dumps(content["example"]))
    assert "[m]" in json.dumps(content["schema"]["properties"]["waypoints"])
    assert "$ref" not in json.dumps(content["schema"])
    assert {"201", "200", "409", "413", "422", "503"} <= set(post["responses"])
    for path, verbs in document["paths"].items():
        for verb, operation in verbs.items():
            assert operation["summary"], (path, verb)
    for name, schema in document["components"]["schemas"].items():
        for key, field in schema["properties"].items():
            assert field.get("description") or name in ("HTTPValidationError", "ValidationError"), (
                name,
                key,
            )
