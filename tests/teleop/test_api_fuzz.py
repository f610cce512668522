"""Requests made at random from the API's own description: no 5xx, no effect without a token."""

import contextlib
import http.client
import json
import urllib.parse
from collections import Counter

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cloudrc.messages import Request
from tests.teleop.conftest import OPERATOR, READER, running

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
good_points = st.tuples(st.just(0.5), st.floats(0.0, 3.6), st.floats(0.6, 0.8)).map(list)
good_missions = st.fixed_dictionaries(
    {"waypoints": st.lists(st.fixed_dictionaries({"position_m": good_points}), min_size=1)},
    optional={
        "queue": st.booleans(),
        "key": st.text("abc", min_size=1, max_size=4),
        "name": st.just("n"),
    },
)
points = st.fixed_dictionaries({"position_m": vectors}, optional={"yaw_deg": anything})
good_goto = st.fixed_dictionaries({"position_m": good_points})
in_json = {
    "/v1/missions": st.one_of(good_missions, good_missions, missions, anything),
    "/v1/goto": st.one_of(good_goto, points, anything),
}


def body_of(path):
    """What this route takes, well or badly made; most take nothing."""
    made = in_json.get(path, anything).map(lambda value: json.dumps(value).encode())
    return made if path in in_json else st.one_of(st.just(b""), st.binary(max_size=60), made)


segments = st.one_of(
    st.sampled_from(["m1", "m2", "..", "%2e%2e", "%00", "", "missions", "cancel", "é"]),
    st.text(max_size=12),
)
strange_paths = st.lists(segments, max_size=4).map(
    lambda parts: "/v1/" + "/".join(urllib.parse.quote(part, safe="%.") for part in parts)
)
methods = st.sampled_from(["GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS", "BREW"])
headers = st.dictionaries(
    st.sampled_from(
        ["Content-Type", "Last-Event-ID", "Accept", "X-Forwarded-For", "Range", "Expect", "Cookie"]
    ),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
)


def described(api):
    """Every route of the API's own description but the stream, which does not end."""
    paths = api.get("/openapi.json")["paths"]
    return sorted(
        (method.upper(), path)
        for path, methods in paths.items()
        for method in methods
        if path != "/v1/events"
    )


NEWEST = "newest"
"""Stands for the mission that was ordered last: what it is called is told by the answer."""
ids = st.sampled_from([NEWEST, NEWEST, NEWEST, "m1", "M1", "é"])
ORDER, CANCEL = ("POST", "/v1/missions"), ("POST", "/v1/missions/{id}/cancel")
STOP = ("POST", "/v1/estop")


@st.composite
def requests(draw, routes):
    """One that the description knows, in nine of ten; else another method, or another path."""
    method, path = routes[draw(st.integers(0, 10**6)) % len(routes)]  # as often one as another
    noise = draw(st.integers(0, 19))
    if noise == 0:
        method = draw(methods)
    elif noise == 1:
        path = draw(strange_paths)
    body = draw(body_of(path))
    path = path.replace("{id}", urllib.parse.quote(draw(ids)))
    return method, path, body, draw(headers)


class Client:
    """One connection that is kept, as long as the server keeps it."""

    def __init__(self, api):
        self._address = api.url.removeprefix("http://")
        self._connection = None
        self._newest = "none"

    def ask(self, method, path, body, header, token):
        """The status; 0 if the server twice closes without a word, which no request may cause."""
        given = {**header, "Authorization": f"Bearer {token}"} if token else dict(header)
        path = path.replace(NEWEST, self._newest)
        for _ in range(2):
            if self._connection is None:
                self._connection = http.client.HTTPConnection(self._address, timeout=10.0)
            try:
                self._connection.request(method, path, body, given)
                answer = self._connection.getresponse()
                told = answer.read()
            except (http.client.HTTPException, OSError):
                self.close()  # the server keeps no connection after a body that it did not read
                continue
            if answer.will_close:
                self.close()
            if answer.status == 201:
                self._newest = json.loads(told)["id"]
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


def fuzz(api, examples, check):
    """Check so many requests of all routes; how often each status was the answer.

    In the first half nobody stops the robot, since then every order is refused until somebody has
    acknowledged it. Orders and cancellations come most often: one after the other they are taken.
    """
    statuses, routes = Counter(), described(api) + 3 * [ORDER, CANCEL]
    for chosen in ([route for route in routes if route != STOP], routes):

        @settings(max_examples=examples // 2, **SETTINGS)
        @given(requests(chosen))
        def each(request):
            statuses[check(*request)] += 1

        each()
    return statuses


def as_operator(api, client, examples):
    def check(method, path, body, header):
        status = client.ask(method, path, body, header, OPERATOR)
        if status == 503:  # the machine is busy; that is what the answer asks for
            status = client.ask(method, path, body, header, OPERATOR)
        assert not api.complaints, (method, path, body, api.complaints)
        assert 200 <= status < 500, (method, path, body, status)
        assert api.gate.counts["failed"] == 0
        return status

    return fuzz(api, examples, check)


def reaches_the_service(statuses, examples):
    """A fuzzer that stays before the door says nothing about the house."""
    assert statuses[200] + statuses[201] >= examples // 8, statuses
    assert statuses[409] >= examples // 40, statuses
    assert statuses[422] >= examples // 40, statuses
    assert statuses[404] + statuses[405] <= examples // 2, statuses


def test_an_operators_requests_never_fail_the_api(api, client):
    reaches_the_service(as_operator(api, client, 150), 150)


@pytest.mark.full
def test_very_many_of_an_operators_requests_never_fail_the_api(api, client):
    statuses = as_operator(api, client, 10_000)
    reaches_the_service(statuses, 10_000)
    assert statuses[201] >= 10, statuses


def test_nobody_else_has_any_effect(api, client):
    before = len(api.flight.kept), commands(api), len(api.alarms)

    def check(method, path, body, header):
        assert client.ask(method, path, body, header, "") == 401
        status = client.ask(method, path, body, header, READER)
        if method in ("GET", "HEAD"):
            assert 200 <= status < 500, (method, path, status)
        else:
            assert status == 403, (method, path, status)
        assert (len(api.flight.kept), commands(api), len(api.alarms)) == before
        return status

    statuses = fuzz(api, 60, check)
    assert statuses[200] >= 3, statuses
    assert statuses[403] >= 15, statuses


def commands(api):
    return sum(r.request is not Request.PROGRESS for r in list(api.flight.requests))
