"""Who may do what over the API: everybody else may do nothing, and nothing gives a token away."""

import argparse
import concurrent.futures
import json
import os
import socket
import stat
import urllib.error
import urllib.request

import pytest

from cloudrc.cli.client import Api, UnreachableError
from cloudrc.cli.teleop import ServedApi, api_address, serve_api
from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError
from cloudrc.teleop.auth import LOCAL
from cloudrc.teleop.server import ApiServer
from cloudrc.teleop.store import Order
from tests.teleop.conftest import OPERATOR, READER, SERVICE_PLAN, connect, running

A_MISSION = {"waypoints": [{"position_m": [0.5, 0.0, 1.0]}]}
WRONG = [
    None,
    "",
    "wrong-token-of-some-length",
    OPERATOR[:-1],
    OPERATOR + "x",
    OPERATOR.upper(),
    "é",
]


@pytest.fixture(scope="module")
def idle():
    with running() as one:
        yield one


def routes(api):
    """Every route that there is, and some that there are not."""
    for path, verbs in api.get("/openapi.json")["paths"].items():
        yield from ((verb.upper(), path.replace("{id}", "m1")) for verb in verbs)
    others = "/", "/openapi.json", "/docs", "/redoc", "/v1", "/metrics", "/v1/missions/../state"
    for path in others:
        yield from ((verb, path) for verb in ("GET", "POST", "PUT", "DELETE", "OPTIONS", "TRACE"))


def bodies(api, path):
    return json.dumps(A_MISSION).encode() if path == "/v1/missions" else b"{}"


@pytest.mark.promise("api-needs-a-token")
@pytest.mark.parametrize("token", WRONG)
def test_without_a_valid_token_every_route_answers_401(idle, token):
    before = idle.flight.kept.copy(), len(idle.flight.requests), len(idle.alarms)
    for method, path in routes(idle):
        headers = {} if token is None else {"Authorization": f"Bearer {token}".encode("latin1")}
        data = None if method == "GET" else bodies(idle, path)
        status, answer = idle.send(idle.request(path, data, None, method, headers))
        assert (status, list(answer)) == (401, ["detail"]), (method, path)
    assert (idle.flight.kept, len(idle.flight.requests), len(idle.alarms)) == before


@pytest.mark.promise("api-needs-a-token")
@pytest.mark.parametrize(
    "header",
    [
        OPERATOR,
        f"Basic {OPERATOR}",
        f"Bearer{OPERATOR}",
        f"Token {OPERATOR}",
        f"Bearer {OPERATOR} x",
    ],
)
def test_only_a_bearer_is_known(idle, header):
    request = idle.request("/v1/state", None, None, "GET", {"Authorization": header})
    assert idle.send(request)[0] == 401


def test_two_headers_are_none(idle):
    connection = connect(idle)
    line = f"Authorization: Bearer {OPERATOR}\r\n"
    connection.sendall(f"GET /v1/state HTTP/1.1\r\nHost: x\r\n{line}{line}\r\n".encode())
    assert b" 401 " in connection.recv(4096)
    connection.close()


def test_the_bearer_scheme_ignores_case_and_is_announced(idle):
    request = idle.request("/v1/state", headers={"Authorization": f"bEARER {OPERATOR}"}, token=None)
    assert idle.send(request)[0] == 200
    connection = connect(idle)
    connection.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
    assert b"www-authenticate: Bearer" in connection.recv(4096)
    connection.close()


@pytest.mark.promise("api-needs-a-token")
def test_a_reader_may_look_and_nothing_else(idle):
    before = idle.flight.kept.copy(), len(idle.flight.requests), len(idle.alarms)
    for method, path in routes(idle):
        if "events" in path:
            continue
        data = None if method == "GET" else bodies(idle, path)
        status, _ = idle.send(idle.request(path, data, READER, method))
        assert status in ((200, 404) if method == "GET" else (403,)), (method, path)
    assert (idle.flight.kept, len(idle.flight.requests), len(idle.alarms)) == before


def test_the_description_names_the_scheme_at_every_route(idle):
    document = idle.get("/openapi.json")
    (scheme,) = document["components"]["securitySchemes"].items()
    assert (scheme[1]["type"], scheme[1]["scheme"]) == ("http", "bearer")
    for path, verbs in document["paths"].items():
        for verb, operation in verbs.items():
            assert operation["security"] == [{scheme[0]: []}], (verb, path)
            assert {"401", "403", "429"} <= set(operation["responses"])


def test_a_network_address_is_not_served_without_tokens():
    with running(unix=True) as api, pytest.raises(BadInputError, match="needs --tokens DIR"):
        ApiServer(api.gate, api.bridge, ("127.0.0.1", 0))


@pytest.mark.parametrize("port", ["0", "18080"])
def test_a_port_without_a_host_is_served_on_this_machine_alone(port):
    host, number = api_address(port)
    assert number == int(port)
    with running() as api:
        server = ApiServer(api.gate, api.bridge, (host, 0))
        server.start()
        url, port = server.url.rpartition(":")[::2]
        assert url == "http://127.0.0.1"
        socket.create_connection(("127.0.0.1", int(port)), timeout=5.0).close()
        with pytest.raises(ConnectionRefusedError):  # all of Linux' 127/8 is this machine
            socket.create_connection(("127.0.0.2", int(port)), timeout=5.0)
        server.stop()


@pytest.mark.parametrize(
    ("where", "told"),
    [("0", False), ("127.0.0.1:0", False), ("localhost:0", False), ("0.0.0.0:0", True)],
)
def test_a_public_address_needs_tokens_and_gets_a_warning(where, told, tmp_path, capsys):
    options = argparse.Namespace(api=api_address(where), tokens=None, audit=None, api_file=None)
    with pytest.raises(BadInputError, match="needs --tokens DIR"):
        serve_api(options, load_experiment("hover"))
    assert ("can be reached from outside" in capsys.readouterr().err) is told


def test_a_socket_file_is_for_its_owner_alone_and_wants_no_token():
    with running(unix=True) as api:
        assert stat.S_IMODE(os.stat(api.address).st_mode) == 0o600
        client = Api(api.url)
        api.until(lambda: client.get("/v1/state")["seen"])
        assert client.post("/v1/missions", A_MISSION)["id"] == "m1"
        assert client.post("/v1/missions/m1/cancel")["state"] == "cancelled"
        (first, _) = api.audited()
        assert (first["token"], first["client"]) == (LOCAL.name, "local")


def test_a_socket_file_that_is_not_there_is_one_sentence(tmp_path):
    with pytest.raises(UnreachableError, match=r"unix:/.* does not answer \(No such file"):
        Api(f"unix:{tmp_path}/none").get("/v1/state")
    with running(unix=True) as api, pytest.raises(BadInputError, match="choose another path"):
        ApiServer(api.gate, api.bridge, tmp_path / "no" / "folder")


def test_a_file_where_the_socket_shall_be_is_left_alone(tmp_path):
    precious = tmp_path / "thesis"
    precious.write_text("mine")
    with running(unix=True) as api, pytest.raises(BadInputError, match="in use; choose another"):
        ApiServer(api.gate, api.bridge, precious)
    assert (BadInputError.exit_code, precious.read_text()) == (2, "mine")


def test_a_thousand_posts_at_once_under_one_key_are_one_mission():
    with running() as api:
        body = json.dumps({**A_MISSION, "key": "uid"}).encode()

        def post(_):
            while True:
                status, answer = api.send(api.request("/v1/missions", body, method="POST"))
                if status not in (429, 503):
                    return status, answer["id"]

        with concurrent.futures.ThreadPoolExecutor(32) as pool:
            answers = list(pool.map(post, range(1000)))
        assert sorted(set(answers)) == [(200, "m1"), (201, "m1")]
        assert answers.count((201, "m1")) == 1
        assert list(api.flight.teleop.book.missions) == ["m1"]


def test_an_alarm_is_sent_after_teleop_is_asked():
    with running() as api:
        steps, submit = [], api.bridge.submit
        api.bridge.submit = lambda *call, **how: (steps.append("asked"), submit(*call, **how))[1]
        api.bridge.alarm = lambda: steps.append("alarm")
        api.post("/v1/estop")
        assert steps == ["asked", "alarm"]
        api.bridge.closed = "another teleop flies"
        assert api.post("/v1/estop") == (503, {"detail": "another teleop flies"})
        assert steps[2:] == ["asked", "alarm"]


@pytest.mark.promise("emergency-stop-gets-through")
def test_a_stop_during_startup_is_passed_on_once_started():
    """Teleop has just died, an alarm rings, and somebody hits the button: it waits for no retry."""
    with running(ready=False) as api, concurrent.futures.ThreadPoolExecutor(1) as pool:
        answer = pool.submit(api.post, "/v1/estop")
        api.until(lambda: api.bridge.stops == 1)
        with pytest.raises(urllib.error.HTTPError, match="503"):
            api.get("/v1/state")
        alarms = []
        served = ServedApi(api.bridge, api.server, api.audit)
        served.open(api.flight.teleop, lambda: alarms.append("past the loop"))
        assert alarms
        assert answer.result() == (200, {"id": None, "state": "stopping"})


def test_a_stop_is_not_kept_for_when_another_teleop_ends():
    with running(ready=False) as api, concurrent.futures.ThreadPoolExecutor(1) as pool:
        answer = pool.submit(api.post, "/v1/estop")
        api.until(lambda: api.bridge.stops == 1)
        api.bridge.close("another teleop flies")
        assert answer.result() == (503, {"detail": "another teleop flies"})
        told = len(api.alarms)
        api.bridge.open(api.flight.teleop)
        assert (len(api.alarms), api.bridge.take_urgent()) == (told, [])


def test_an_emergency_stop_is_one_alarm():
    with running() as api:
        api.flight.teleop.create(Order(SERVICE_PLAN), 0)
        status, answer = api.post("/v1/estop")
        assert (status, answer) == (200, {"id": "m1", "state": "stopping"})
        assert len(api.alarms) == 1
        status, answer = api.post("/v1/acknowledge")
        assert (status, answer) == (200, {"state": "acknowledged"})


def test_a_fault_of_the_application_is_one_line_and_500():
    with running() as api:
        api.flight.teleop.hold = None
        for _ in range(2):
            status, answer = api.post("/v1/hold")
            assert (status, answer) == (500, {"detail": "the API failed; see teleop's log"})
        (line,) = api.complaints
        assert line.startswith("the API failed at /v1/hold: TypeError")
        api.until(lambda: api.gate.counts["failed"] == 2)  # counted after the answer


def test_nothing_but_http_gets_an_answer(idle):
    for data in (b"\x00" * 100, b"GET\r\n\r\n", b"\x16\x03\x01\x02\x00", b"A" * 20_000):
        connection = connect(idle)
        connection.sendall(data)
        answer = connection.recv(4096)
        assert answer == b"" or b" 400 " in answer
        connection.close()
    upgrade = idle.request("/v1/state", headers={"Connection": "Upgrade", "Upgrade": "websocket"})
    assert idle.send(upgrade)[0] == 200


def test_the_audit_log_ignores_forwarded_addresses():
    """uvicorn would believe anybody on this machine that he is a proxy."""
    named = {"X-Forwarded-For": "203.0.113.7", "X-Forwarded-Proto": "https"}
    with running() as api:
        assert api.send(api.request("/v1/hold", b"", headers=named, method="POST"))[0] == 409
        (line,) = api.audited()
        assert line["client"].rpartition(":")[0] == "127.0.0.1"


def test_no_web_socket_is_opened(idle):
    """uvicorn would open one if a library for that is installed; the gate knows HTTP alone."""
    names = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec-WebSocket-Version": "13"}
    key = {"Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    assert idle.send(idle.request("/v1/state", headers=names | key))[0] == 200
    assert idle.server._server.config.ws_protocol_class is None


def test_a_proxy_is_never_asked(monkeypatch):
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")
    with running() as api:
        assert Api(api.url, lambda: OPERATOR).get("/v1/state")
    assert urllib.request.getproxies()["http"] == "http://127.0.0.1:9"
