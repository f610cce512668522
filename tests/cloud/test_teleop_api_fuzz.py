"""Requests made at random from the API's own description: no 5xx, no effect without a token."""

import contextlib
import http.client
import json
import urllib.parse

import pytest
from api_harness import OPERATOR, READER, running
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cloudrc.messages import Request

pytestmark = pytest.mark.promise("P-API-11")
SETTINGS = {"deadline": None, "suppress_health_check": list(HealthCheck)}

numbers = st.one_of(
    st.floats(),
    st.integers(-(10**30), 10**30),
    st.sampled_from([0, -0.0, 1e308, 5e-324, float("inf"), float("nan"), 2**63, -1]),
)
scalars = st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=20))
anything = st.recursive(
    scalars,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)
vectors = st.one_of(st.lists(numbers, min_size=3, max_size=3), anything)
waypoints = st.fixed_dictionaries(
    {"position_m": vectors},
    optional={
        "yaw_deg": anything,
        "tolerance_m": anything,
        "dwell_s": anything,
        "time_limit_s": anything,
    },
)
missions = st.fixed_dictionaries(
    {"waypoints": st.one_of(st.lists(st.one_of(waypoints, anything), max_size=5), anything)},
    optional={
        "start": anything | st.sampled_from(["spawn", "here"]),
        "name": anything,
        "description": anything,
        "time_limit_s": anything,
        "contact": anything,
        "key": anything,
        "queue": anything,
        "steps": anything,
    },
)
bodies = st.one_of(
    st.binary(max_size=60),
    anything.map(lambda value: json.dumps(value).encode()),
    missions.map(lambda value: json.dumps(value).encode()),
    st.fixed_dictionaries({"position_m": vectors}, optional={"yaw_deg": anything}).map(
        lambda value: json.dumps(value).encode()
    ),
)
segments = st.one_of(
    st.sampled_from(["m1", "m2", "..", "%2e%2e", "%00", "", "missions", "cancel", "é"]),
    st.text(max_size=12),
)
paths = st.one_of(
    st.sampled_from(
        ["/v1/missions", "/v1/goto", "/v1/hold", "/v1/resume", "/v1/state", "/v1/estop",
         "/v1/acknowledge", "/v1/missions/m1", "/v1/missions/m1/cancel", "/openapi.json"]
    ),
    st.lists(segments, max_size=4).map(
        lambda parts: "/v1/" + "/".join(urllib.parse.quote(p, safe="%.") for p in parts)
    ),
)  # fmt: skip
methods = st.sampled_from(["GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS", "BREW"])
headers = st.dictionaries(
    st.sampled_from(
        ["Content-Type", "Last-Event-ID", "Accept", "X-Forwarded-For", "Range", "Expect", "Cookie"]
    ),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
)


class Client:
    """One connection that is kept, as long as the server keeps it."""

    def __init__(self, api):
        self._address = api.url.removeprefix("http://")
        self._connection = None

    def ask(self, method, path, body, header, token):
        given = {**header, "Authorization": f"Bearer {token}"} if token else dict(header)
        for _ in range(2):
            if self._connection is None:
                self._connection = http.client.HTTPConnection(self._address, timeout=10.0)
            try:
                self._connection.request(method, path, body, given)
                answer = self._connection.getresponse()
                answer.read()
            except (http.client.HTTPException, OSError):
                self.close()  # the server keeps no connection after a body that it did not read
                continue
            if answer.will_close:
                self.close()
            return answer.status
        return 0

    def close(self):
        if self._connection is not None:
            with contextlib.suppress(OSError):
                self._connection.close()
            self._connection = None


@pytest.fixture(scope="module")
def api():
    with running() as one:
        yield one


@pytest.fixture(scope="module")
def client(api):
    one = Client(api)
    yield one
    one.close()


def fuzz(examples):
    def decorate(test):
        return settings(max_examples=examples, **SETTINGS)(
            given(methods, paths, bodies, headers)(test)
        )

    return decorate


@fuzz(150)
def test_an_operators_requests_never_fail_the_api(api, client, method, path, body, header):
    status = client.ask(method, path, body, header, OPERATOR)
    assert status < 500, (method, path, body, status)
    assert api.gate.counts["failed"] == 0
    assert not api.complaints


@pytest.mark.full
@fuzz(10_000)
def test_very_many_of_an_operators_requests_never_fail_the_api(
    api, client, method, path, body, header
):
    assert client.ask(method, path, body, header, OPERATOR) < 500
    assert not api.complaints


@fuzz(100)
def test_nobody_else_has_any_effect(api, client, method, path, body, header):
    before = len(api.flight.kept), commands(api), len(api.alarms)
    assert client.ask(method, path, body, header, "") in (401, 0)
    status = client.ask(method, path, body, header, READER)
    assert status == 403 if method not in ("GET", "HEAD") else status < 500
    assert (len(api.flight.kept), commands(api), len(api.alarms)) == before


def commands(api):
    return sum(r.request is not Request.PROGRESS for r in list(api.flight.requests))
