# SPDX-License-Identifier: Apache-2.0

"""The API over HTTP, as its clients meet it."""

import asyncio
import concurrent.futures
import json
import stat
import time

import pytest

from cloudrc.doors.cli.process_teleop import api_address
from cloudrc.results.exposition.live import LiveMetrics
from cloudrc.teleop import api as api_module
from cloudrc.teleop import auth, models
from cloudrc.teleop.api import ApiServer, Bridge
from cloudrc.teleop.client import Api, UnreachableError
from cloudrc.teleop.refusals import ConflictError
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import Counted
from tests.support.http import DIRECT
from tests.teleop.conftest import (
    A_MISSION,
    OPERATOR,
    READER,
    A,
    B,
    C,
    connect,
    head,
    running,
)

LEG = {"dwell_s": 0.0, "tolerance_m": 0.3}
NAME = "zum Brett, \N{RIGHTWARDS ARROW} 板"
MISSION = {"name": NAME, "waypoints": [{"position_m": p, **LEG} for p in (A, B, C)]}
emergency_stop = pytest.mark.promise("emergency-stop-gets-through")


def finish(api, mission_id):
    api.visit(mission_id, A, B, C)
    api.until(lambda: api.state_of(mission_id) == "done")


# Missions


def test_a_mission_from_post_to_verdict(api):
    status, view = api.post("/v1/missions", {**MISSION, "key": "uid"})
    assert (status, view["id"], view["state"], view["waypoints"]) == (201, "m1", "starting", 3)
    finish(api, "m1")
    view = api.get("/v1/missions/m1")
    assert (view["name"], view["verdict"]["outcome"]) == (NAME, "success")
    assert [mission["id"] for mission in api.get("/v1/missions")["missions"]] == ["m1"]
    status, again = api.post("/v1/missions", {**MISSION, "key": "uid"})
    assert (status, again["id"]) == (200, "m1")
    assert api.post("/v1/missions/m1/cancel")[0] == 409
    assert api.post("/v1/missions/m99/cancel")[0] == 404


@pytest.mark.fault(
    34,
    "second-mission",
    injects="another mission is posted during a mission",
    expects="the new mission is refused, with the name of the one that flies",
    figures="status 409",
)
def test_the_operator_steers_and_a_conflict_names_its_mission(api):
    assert api.post("/v1/resume")[0] == 409
    mission_id, (point,) = api.fly(MISSION), A_MISSION["waypoints"]
    for path, body in (("missions", MISSION), ("goto", point)):
        status, refusal = api.post(f"/v1/{path}", body)
        assert (status, refusal["id"], mission_id in refusal["detail"]) == (409, mission_id, True)
    assert api.post("/v1/hold")[1]["state"] == "held"
    assert api.post("/v1/goto", point)[0] == 200
    assert api.post("/v1/resume")[1]["state"] == "flying"
    assert api.post("/v1/missions", {**MISSION, "queue": True})[1]["state"] == "queued"
    state = api.get("/v1/state")
    assert (state["mission"]["id"], state["queue"]) == (mission_id, ["m2"])
    assert (state["seen"]["guard"], state["seen"]["rtt_s"]) == ("TRACK", None)


def test_a_lease_is_renewed_and_an_impossible_one_refused(api):
    mission_id = api.fly({**MISSION, "lease_s": 30.0})
    assert api.flight.teleop.book.find(mission_id).order.lease == 30.0
    assert api.post(f"/v1/missions/{mission_id}/renew")[1]["id"] == mission_id
    assert api.post("/v1/missions/m99/renew")[0] == 404
    for lease in (4.9, 3601):
        assert api.post("/v1/missions", {**MISSION, "lease_s": lease})[0] == 422


def test_requests_and_refusals_become_metrics(api):
    api.fly(MISSION)
    assert api.post("/v1/goto", {"position_m": [100.0, 0.0, 1.0]})[0] == 422
    assert api.post("/v1/missions", MISSION)[0] == 409
    assert api.post("/v1/hold", token=READER)[0] == 403

    def reading(name):
        live = LiveMetrics("teleop")
        live.see([Counted(0, "teleop", *count) for count in api.server.counts.items()])
        return live.read().get(f"cloudrc_{name}_total")

    wanted = {("invalid",): 1, ("conflict",): 1}
    api.until(lambda: reading("missions_refused") == wanted)  # counted after the answer
    assert reading("api_rejected")[("role",)] == 1


# Events


def read_events(api, count, after=0, last=0):
    events, numbers = [], []
    request = api.request(f"/v1/events?after={after}", headers={"Last-Event-ID": str(last)})
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
    with concurrent.futures.ThreadPoolExecutor(1) as pool:
        arrived = pool.submit(read_events, api, 6)
        finish(api, api.fly(MISSION))
        numbers, events = arrived.result()
    for event in events:
        models.Event.model_validate(event)
    assert numbers == [event["id"] for event in events] == [1, 2, 3, 4, 5, 6]
    assert [event["event"] for event in events[:2]] == ["starting", "started"]
    assert read_events(api, 2, after=4)[0] == [5, 6]
    assert read_events(api, 1, after=4, last=5)[0] == [6]
    assert read_events(api, 1, after=999)[0] == [1]  # of a journal that is gone
    for after in ("rubbish", "-1", "9" * 16):
        assert api.send(api.request(f"/v1/events?after={after}"))[0] == 422


def test_a_stream_shows_its_life_until_its_token_is_withdrawn(monkeypatch):
    monkeypatch.setattr(api_module, "ALIVE_PERIOD", 0.05)
    monkeypatch.setattr(api_module, "LOOK_PERIOD", 0.01)
    with running() as api, connect(api) as stream, DIRECT.open(api.request("/v1/events")):
        stream.sendall(head("GET", "/v1/events", token=READER))
        said = b""
        while b": alive" not in said:
            said += stream.recv(4096)
        api.token_file.with_name("reader").unlink()
        while not said.endswith(b"\r\n0\r\n\r\n"):  # the end
            said += stream.recv(4096)
        began = time.monotonic()
        api.server.stop()  # although the other stream is open
        api.server.stop = lambda: None
        assert time.monotonic() - began < 1.5


# The robot's status


def test_a_reader_follows_the_robot_until_teleop_ends():
    with running(uplink=False) as api:
        statuses = Api(api.url, lambda: READER).robot()
        assert next(statuses) is None, "no telemetry yet"
        api.flight.uplink, api.flight.position = True, A
        began = time.monotonic()
        assert {next(statuses).position for _ in range(31)} <= {(0.0, 0.0, 0.1), A}
        assert time.monotonic() - began < 31 / 20.0, "20 updates a second or more"
        assert next(statuses).position == A
        api.bridge.closed = "teleop ends"
        assert len([*statuses]) < 5


# Stop and hold


@emergency_stop
@pytest.mark.parametrize("path", ["/v1/estop", "/v1/estop/"])
def test_a_stop_stops_the_robot_with_or_without_a_slash(api, path):
    api.flight.create()
    assert api.post(path) == (200, {"id": "m1", "state": "stopping"})
    assert len(api.alarms) == 1
    api.until(lambda: api.get("/v1/state")["seen"]["guard"] == "ESTOP")
    assert api.post("/v1/acknowledge/") == (200, {"state": "acknowledged"})
    api.bridge.closed = "teleop ends"
    assert api.post(path) == (503, {"detail": "teleop ends"})
    assert len(api.alarms) == 2, "cloud is told all the same"


@emergency_stop
def test_a_full_api_still_serves_stop_and_hold(api):
    """Readers' and operators' requests wait for a loop that waits for its disk."""
    waiting, urgent = ([connect(api) for _ in range(n)] for n in (2 * auth.IN_FLIGHT_MAX, 4))
    with api.stalled():
        for number, connection in enumerate(waiting):
            connection.sendall(head("GET", "/v1/state", token=(READER, OPERATOR)[number % 2]))
        api.until(lambda: api.gate._in_flight.total() == len(waiting))
        for token in (READER, OPERATOR):
            status, answer = api.send(api.request("/v1/state", token=token))
            assert (status, answer) == (429, {"detail": "too many requests; try again in a second"})
        assert api.post("/v1/resume")[0] == 429
        assert api.post("/v1/hold", token=READER)[0] == 403
        for connection, path in zip(urgent, ["/v1/hold", "/v1/estop/"] * 2, strict=True):
            connection.sendall(head("POST", path, "Content-Length: 0"))
        api.until(lambda: len(api.alarms) == 2 and api.bridge.overtakings == 4)
    answers = [connection.recv(4096)[9:12] for connection in urgent]
    assert answers == [b"409", b"200"] * 2, "nothing flies that could hold"
    for connection in (*waiting, *urgent):
        connection.close()


@emergency_stop
def test_a_stop_is_made_however_late_teleop_answers(api, monkeypatch):
    """Of other calls only those are made whose client still waits."""
    monkeypatch.setattr(api_module, "ANSWER_LIMIT", 0.1)
    mission_id = api.fly(MISSION)
    with api.stalled():
        assert api.post(f"/v1/missions/{mission_id}/cancel")[0] == 503
        assert api.post("/v1/estop")[0] == 503
    api.until(lambda: api.flight.guard is GuardState.ESTOP)
    api.until(lambda: api.flight.names(mission_id)[-1] == "emergency_stopped")


@emergency_stop
@pytest.mark.parametrize("locked", [False, True])
def test_a_stop_while_teleop_starts_is_its_first_call(locked):
    with running(ready=False) as api, concurrent.futures.ThreadPoolExecutor(1) as pool:
        answer = pool.submit(api.post, "/v1/estop")
        api.until(lambda: api.bridge.overtakings == 1)
        assert api.post("/v1/hold") == (503, {"detail": "teleop is starting"})
        if locked:
            api.bridge.close("another teleop has this journal open")
            refusal = 503, {"detail": "another teleop has this journal open"}
            assert answer.result() == api.post("/v1/missions", A_MISSION) == refusal
        else:
            api.bridge.open(api.flight.teleop)
            assert answer.result() == (200, {"id": None, "state": "stopping"})


@pytest.mark.parametrize("urgent", ["stop", "hold"])
def test_a_later_stop_or_hold_cancels_a_call_that_moves(urgent):
    async def overtake():
        bridge = Bridge()
        bridge.open(object())
        moving = asyncio.ensure_future(bridge.move(lambda service, now_ns: "moved"))
        await asyncio.sleep(0)
        bridge.submit(lambda service, now_ns: None, urgent)
        bridge.make_calls(0)
        with pytest.raises(ConflictError, match="a later stop or hold cancels this"):
            await moving

    asyncio.run(overtake())


# Bodies and heads


def test_a_body_that_is_too_long_is_not_awaited(api):
    with connect(api) as connection:
        connection.sendall(head("POST", "/v1/goto", "Transfer-Encoding: chunked"))
        for _ in range(5):
            connection.sendall(b"10000\r\n" + b" " * 0x10000 + b"\r\n")
        assert b" 413 " in connection.recv(4096)


# The server


@pytest.mark.parametrize(("where", "host"), [("0", "127.0.0.1"), ("[::1]:0", "::1")])
def test_a_network_address_needs_tokens(where, host, refused):
    assert api_address(where) == (host, 0)
    line = refused(f"process teleop --config hover.yaml --socket . --api {where}")
    assert "needs --tokens DIR" in line


def test_a_socket_file_is_for_its_owner_and_needs_no_token(tmp_path):
    with running(unix=True) as api:
        assert stat.S_IMODE(api.address.stat().st_mode) == 0o600
        ApiServer(api.gate, api.bridge, api.address)._socket.close()  # replaces what is left over
    with running(unix=True) as api:
        client = Api(api.url)
        api.until(lambda: client.get("/v1/state")["seen"])
        assert client.post("/v1/missions", A_MISSION)["id"] == "m1"
        (line,) = api.logged()
        assert line.startswith("local local POST /v1/missions: 201 m1")
    with pytest.raises(UnreachableError, match="No such file"):
        Api(f"unix:{tmp_path}/none").get("/v1/state")
