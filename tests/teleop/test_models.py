# SPDX-License-Identifier: Apache-2.0

"""Orders to the API: what cannot be used is named, and no way leads through a pipe's wall."""

import pytest

from cloudrc.config import shipped
from cloudrc.config.load import load_experiment
from cloudrc.teleop import models

POINT = {"position_m": [0.5, 0.0, 1.0]}
WEST, BORE, EAST = (-2.5, 0.0, 0.8), (-1.0, 0.0, 0.8), (0.5, 0.0, 0.8)
"""Beside and in pipe 1, which lies from y = 2.5 to -2.5 at x = -1, z = 0.8, 1.3 m wide [m]."""


def waypoint(**more):
    return {"waypoints": [POINT | more]}


@pytest.mark.promise("bad-missions-are-refused")
@pytest.mark.parametrize(
    ("body", "path", "index", "words"),
    [
        ({"waypoints": [POINT, {"position_m": [99, 0, 1]}]},
         "waypoints.1.position_m", 1, "beyond the fence"),
        (waypoint(position_m=[-0.4, 2.0, 0.8]), "waypoints.0.position_m", 0, "wall of pipe"),
        (waypoint(dwell=1), "waypoints.0.dwell", 0, "did you mean dwell_s"),
        (b"nonsense", "", None, "must be JSON"),
    ],
)  # fmt: skip
def test_a_value_that_cannot_be_used_is_named(api, body, path, index, words):
    status, refusal = api.post("/v1/missions", body)
    models.Refusal.model_validate(refusal)
    assert status == 422
    problem = next(p for p in refusal["problems"] if p["path"] == path)
    assert problem["index"] == index
    assert words in problem["reason"]
    assert path in refusal["detail"] or len(refusal["problems"]) > 3
    assert refusal["detail"].isprintable()
    assert api.get("/v1/missions")["missions"] == []


# Straight ways


def at(api, position):
    def is_seen():
        seen = api.get("/v1/state")["seen"]
        return seen is not None and seen["position_m"] == list(position)

    api.flight.position = position
    api.until(is_seen)


@pytest.mark.parametrize(
    ("here", "there", "free"),
    [
        (WEST, BORE, False),
        (BORE, EAST, False),
        ((0.0, 0.0, 0.1), (0.0, 0.0, 1.2), False),  # the rear rotor would lift into the outside
        (BORE, (-1.0, 2.0, 0.8), True),
        ((-2.5, 0.0, 2.0), (0.5, 0.0, 2.0), True),
    ],
)
def test_nobody_is_sent_straight_through_a_pipe(api, here, there, free):
    mission_id = api.fly(waypoint(position_m=EAST))
    at(api, here)
    for path, body in (("goto", {"position_m": there}), ("resume", None)):
        assert "wall" not in api.post(f"/v1/{path}", body)[1]["detail"], "first hold the mission"
    api.post("/v1/hold")
    status, answer = api.post("/v1/goto", {"position_m": there})
    assert (status, answer["id"]) == (200 if free else 409, mission_id)
    assert free or "through the wall of pipe_1; go round it first" in answer["detail"]


def test_a_mission_from_here_begins_with_a_free_way(api):
    order = {"start": "here", **waypoint(position_m=EAST), "key": "again"}
    at(api, WEST)
    status, refusal = api.post("/v1/missions", order)
    assert status == 409
    assert "through the wall of pipe_1" in refusal["detail"]
    at(api, (0.5, 1.0, 0.8))
    assert api.post("/v1/missions", order)[0] == 201
    at(api, WEST)
    assert api.post("/v1/missions", order)[0] == 200, "the mission is known, whatever the place"
    later = {**order, "key": "later", "queue": True}
    assert api.post("/v1/missions", later)[0] == 201, "it may begin elsewhere"


OTHER = {"steps", "slalom", "pillars"}  # for the scenes `empty` and `pillars`


@pytest.mark.parametrize("name", sorted(set(shipped.names("mission")) - OTHER))
def test_each_shipped_mission_flies_on_the_default_release(name):
    load_experiment("paper", [f"mission={name}"])  # an error if a pipe is in the way
