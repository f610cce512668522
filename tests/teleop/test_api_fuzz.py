"""Requests made at random from the API's own description: no 5xx, no effect without a token."""

import json
import urllib.parse
from collections import Counter

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.teleop.conftest import OPERATOR, running

SETTINGS = {"deadline": None, "suppress_health_check": list(HealthCheck)}
NEWEST = "newest"
"""Stands for the id of the mission that was ordered last."""
ORDER, CANCEL = ("POST", "/v1/missions"), ("POST", "/v1/missions/{id}/cancel")
STOP = ("POST", "/v1/estop")

extremes = st.sampled_from([0, -0.0, 1e308, 5e-324, float("inf"), float("nan"), 2**63, -1])
numbers = st.floats() | st.integers(-(10**30), 10**30) | extremes
anything = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)
vectors = st.lists(numbers, min_size=3, max_size=3) | anything
keys = ["yaw_deg", "tolerance_m", "dwell_s", "time_limit_s"]
waypoints = st.fixed_dictionaries({"position_m": vectors}, optional=dict.fromkeys(keys, anything))
keys = ["start", "name", "description", "time_limit_s", "contact", "key", "queue", "steps"]
missions = st.fixed_dictionaries(
    {"waypoints": st.lists(waypoints | anything, max_size=5) | anything},
    optional=dict.fromkeys(keys, anything),
)
good_points = st.tuples(st.just(0.5), st.floats(0.0, 3.6), st.floats(0.6, 0.8)).map(list)
good_goto = st.fixed_dictionaries({"position_m": good_points})
good_missions = st.fixed_dictionaries(
    {"waypoints": st.lists(good_goto, min_size=1)},
    optional={"queue": st.booleans(), "key": st.text("abc", min_size=1, max_size=4)},
)
in_json = {
    "/v1/missions": good_missions | good_missions | missions | anything,
    "/v1/goto": good_goto | waypoints | anything,
}
ids = st.sampled_from([NEWEST, NEWEST, NEWEST, "m1", "M1", "é"])
segments = st.sampled_from(["m1", "..", "%2e%2e", "%00", "", "missions", "é"]) | st.text(max_size=9)
strange_paths = st.lists(segments, max_size=4).map(
    lambda parts: "/v1/" + "/".join(urllib.parse.quote(part, safe="%.") for part in parts)
)
methods = st.sampled_from(["GET", "POST", "PUT", "PATCH", "DELETE", "HEAD", "OPTIONS", "BREW"])
headers = st.dictionaries(
    st.sampled_from(["Content-Type", "Last-Event-ID", "Accept", "Range", "Expect", "Cookie"]),
    st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=20),
)


@st.composite
def requests(draw, routes):
    """Make a request of the description; one in ten has another method or path."""
    method, path = routes[draw(st.integers(0, 10**6)) % len(routes)]  # each as often
    noise = draw(st.integers(0, 19))
    if noise == 0:
        method = draw(methods)
    elif noise == 1:
        path = draw(strange_paths)
    made = in_json.get(path, anything).map(lambda value: json.dumps(value).encode())
    body = draw(made if path in in_json else st.just(b"") | st.binary(max_size=60) | made)
    return method, path.replace("{id}", urllib.parse.quote(draw(ids))), body, draw(headers)


@pytest.fixture(scope="module")
def api():
    with running() as one:
        yield one


@pytest.mark.parametrize("examples", [80, pytest.param(10_000, marks=pytest.mark.full)])
def test_an_operators_requests_never_fail_the_api(api, examples):
    """In the first half nobody stops the robot, since a stop forbids all orders."""
    paths = api.get("/openapi.json")["paths"]
    routes = [(verb.upper(), path) for path, verbs in paths.items() for verb in verbs]
    routes = sorted(each for each in routes if each[1] != "/v1/events") + 3 * [ORDER, CANCEL]
    statuses, newest = Counter(), ["none"]
    for chosen in ([route for route in routes if route != STOP], routes):

        @settings(max_examples=examples // 2, derandomize=examples < 1000, **SETTINGS)
        @given(requests(chosen))
        def each(request):
            method, path, body, header = request
            path = path.replace(NEWEST, newest[-1])
            for _ in range(2):  # 503: the machine is busy, and the answer asks to try again
                status, answer = api.send(api.request(path, body, OPERATOR, method, header))
                if status != 503:
                    break
            if status == 201:
                newest.append(answer["id"])
            assert not api.complaints, (request, api.complaints)
            assert 200 <= status < 500, (request, status)
            statuses[status] += 1

        each()
    assert statuses[200] + statuses[201] >= examples // 8, statuses  # they reach the service
    assert min(statuses[409], statuses[422]) >= max(1, examples // 40), statuses
