"""A point that is offered in place of one that the guard keeps the robot from is reached."""

from __future__ import annotations

import re

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError
from cloudrc.records import MissionEvent
from tests.flights.conftest import records


def settings(position: list[float], scene: str) -> list[str]:
    return [
        f"mission.waypoints=[{{position_m: {position}}}]",
        f"world.scene={scene}",
        "criteria.time_limit_s=25",
    ]


@pytest.mark.parametrize(
    ("position", "scene"), [([9.2, 0.0, 1.0], "empty"), ([0.0, 0.0, 1.0], "pipes")]
)
def test_the_offered_point_is_reached(position: list[float], scene: str) -> None:
    with pytest.raises(BadInputError) as caught:
        load_experiment("hover", settings(position, scene))
    offered = re.search(r"nearest legal point found: \[(.*)\]", str(caught.value))
    assert offered is not None
    near = [float(word) for word in offered[1].split(",")]
    _, cloud = records(load_experiment("hover", settings(near, scene)))
    events = [record.event for record in cloud if isinstance(record, MissionEvent)]
    assert events == ["started", "reached", "done"]
