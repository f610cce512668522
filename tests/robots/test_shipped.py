"""Each shipped multirotor flies the same missions over the same links."""

import pytest

import cloudrc
from cloudrc.config.robot import find_robot

STEPS = {"mission.steps.count": 4, "link.profile": "paper-p2"}


@pytest.mark.parametrize("robot", ["nano", "x2"])
def test_a_multirotor_flies_steps_like_the_pelican(robot):
    mine, pelican = (cloudrc.fly("steps", STEPS | {"world.robot": r}) for r in (robot, "pelican"))
    assert mine.verdict == pelican.verdict == "success"
    assert mine.numbers["iae_mean"] < 1.3 * pelican.numbers["iae_mean"]
    assert mine.numbers["hold_count"] == 0


def test_a_model_alone_flies(tmp_path):
    """A user has an MJCF file of a multirotor, and no line of YAML."""
    model = tmp_path / "mine.xml"
    model.write_text(find_robot("x2").model.read_text().replace('mass="1.22"', 'mass="1.6"'))
    flight = cloudrc.fly("steps", STEPS | {"world.robot": str(model)})
    assert flight.verdict == "success"
    assert any("mine.xml alone, without a robot.yaml" in note for note in flight.notes)


def test_equal_flights_have_equal_records():
    flights = [cloudrc.fly("steps", STEPS | {"world.robot": "nano"}) for _ in range(2)]
    assert flights[0].records_sha256 == flights[1].records_sha256
