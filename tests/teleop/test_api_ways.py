"""The straight ways on which the operator's words send a robot: none through the wall of a pipe."""

from tests.teleop.conftest import running

WEST, BORE, EAST = (-2.5, 0.0, 0.8), (-1.0, 0.0, 0.8), (0.5, 0.0, 0.8)
"""Beside and in pipe 1, which lies from y = 2.5 to -2.5 at x = -1, z = 0.8, 1.3 m wide."""


def at(api, position):
    api.flight.position = position
    api.until(lambda: api.get("/v1/state")["seen"]["position_m"] == list(position))


def held(api):
    _, view = api.post("/v1/missions", {"waypoints": [{"position_m": EAST}]})
    api.until(lambda: api.state_of(view["id"]) == "flying")
    assert api.post("/v1/hold")[1]["state"] == "held"
    return view["id"]


def test_nobody_is_sent_straight_through_a_pipe():
    with running() as api:
        mission_id = held(api)
        for here, there in ((WEST, BORE), (WEST, EAST), (BORE, EAST)):
            at(api, here)
            status, refusal = api.post("/v1/goto", {"position_m": there})
            assert (status, refusal["id"]) == (409, mission_id)
            assert "through the wall of pipe_1; go round it first" in refusal["detail"]
        status, refusal = api.post("/v1/resume")
        assert (status, refusal["id"]) == (409, mission_id), "its waypoint is beyond that wall, too"
        assert api.state_of(mission_id) == "held"


def test_the_whole_robot_counts_from_where_it_is():
    """Straight above the spawn the rear rotor would lift into the outside of pipe 1."""
    with running() as api:
        held(api)
        at(api, (0.0, 0.0, 0.1))
        status, refusal = api.post("/v1/goto", {"position_m": (0.0, 0.0, 1.2)})
        assert status == 409
        assert "wall of pipe_1" in refusal["detail"]
        at(api, (0.0, 0.0, 1.3))
        assert api.post("/v1/goto", {"position_m": (0.0, 0.0, 1.2)})[0] == 200


def test_along_the_bore_and_over_the_pipe_there_is_a_way():
    with running() as api:
        held(api)
        at(api, BORE)
        assert api.post("/v1/goto", {"position_m": (-1.0, 2.0, 0.8)})[0] == 200
        at(api, (-2.5, 0.0, 2.0))
        assert api.post("/v1/goto", {"position_m": (0.5, 0.0, 2.0)})[0] == 200
        at(api, (0.5, 0.0, 2.0))
        assert api.post("/v1/resume")[0] == 200


def test_a_running_mission_is_reported_before_an_obstacle():
    with running() as api:
        _, view = api.post("/v1/missions", {"waypoints": [{"position_m": EAST}]})
        api.until(lambda: api.state_of(view["id"]) == "flying")
        at(api, BORE)
        for path, body in (("goto", {"position_m": EAST}), ("resume", None)):
            assert "wall" not in api.post(f"/v1/{path}", body)[1]["detail"]


def test_a_mission_from_here_begins_with_a_way_that_can_be_flown():
    order = {"start": "here", "waypoints": [{"position_m": EAST}], "key": "again"}
    with running() as api:
        at(api, WEST)
        status, refusal = api.post("/v1/missions", order)
        assert status == 409
        assert "through the wall of pipe_1" in refusal["detail"]
        assert api.post("/v1/missions", {**order, "start": "spawn"})[0] == 201
        assert api.post("/v1/missions", order)[0] == 200, "known already, wherever the robot is"
