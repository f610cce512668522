"""Limits and size of a robot in robot.yaml; a wrong value is one line with file, line and key."""

import pytest

from cloudrc.config.robot import find_robot
from cloudrc.errors import BadInputError


@pytest.fixture
def read(tmp_path):
    """Return a function that reads a robot.yaml with these keys."""

    def find(*keys, onboard="multirotor"):
        lines = "\n".join([f"onboard: {onboard}", *keys])
        (tmp_path / "robot.yaml").write_text(lines)
        return find_robot(str(tmp_path))

    return find


@pytest.mark.parametrize(
    ("onboard", "keys", "stop"),
    [
        ("multirotor", [], "land"),
        ("diff_drive", ["planar: true"], "brake"),
        ("multirotor", ["guard: {stop: brake}"], "brake"),
        ("diff_drive", ["planar: true", "guard: {stop: brake}"], "brake"),
    ],
)
def test_a_robot_lands_unless_it_is_planar_or_says_that_it_brakes(read, onboard, keys, stop):
    assert read(*keys, onboard=onboard).guard.stop == stop


def test_limits_and_hull_are_read_and_have_defaults(read):
    assert read().guard.model_dump() == {
        "speed_max_mps": None,
        "acceleration_max_mps2": 4.0,
        "braking_mps2": 3.0,
        "stop": "land",
    }
    assert read().hull is None
    robot = read("guard: {braking_mps2: 2, speed_max_mps: 1.5}", "hull_m: 0.35")
    assert (robot.guard.braking_mps2, robot.guard.speed_max_mps, robot.hull) == (2.0, 1.5, 0.35)


SEVENTEEN = f"sensors: {{{', '.join(f'a{n}: {{unit: m, sensor: a}}' for n in range(17))}}}"


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ("guard: {braking_mps2: -1}", "guard.braking_mps2: -1: must be a number >= 0.1 and <= 10"),
        ("guard: {braking_mps2: 0}", "guard.braking_mps2: 0: must be a number >= 0.1"),
        ("guard: {braking_mps2: 50}", "guard.braking_mps2: 50: must be a number >= 0.1 and <= 10"),
        ("guard: {braking_mps2: .nan}", "guard.braking_mps2: nan: must be finite"),
        ("guard: {braking_mps2: '2'}", "guard.braking_mps2: '2': must be a number"),
        ("guard: {braking: 2}", "guard.braking: unknown key; did you mean braking_mps2"),
        ("guard: {speed_max_mps: 0}", "guard.speed_max_mps: 0: must be a number >= 0.01"),
        ("guard: {acceleration_max_mps2: -2}", "guard.acceleration_max_mps2: -2: must be"),
        ("guard: {stop: hover}", "guard.stop: 'hover': must be 'land' or 'brake'"),
        ("guard: 3", "guard: 3: must be a mapping of keys"),
        ("garud: {}", "garud: unknown key; did you mean guard?"),
        ("hull_m: 0", "hull_m: 0: must be a number > 0 and <= 10"),
        ("hull_m: -0.3", "hull_m: -0.3: must be a number > 0 and <= 10"),
        ("hull_m: 350", "hull_m: 350: must be a number > 0 and <= 10"),
        ("probe: ''", "probe: '': must be"),
        ("probe: 3", "probe: 3: must be text"),
        ("sensors: [range]", "sensors: ['range']: must be a mapping of keys"),
        ("sensors: {range: m}", "sensors.range: 'm': must be a mapping of keys"),
        ("sensors: {range: {sensor: a}}", "sensors.range.unit: is missing; must be text"),
        (
            "sensors: {range: {unit: m, sensor: a, scale: 2}}",
            "sensors.range.scale: unknown key; known here: unit, sensor",
        ),
        ("sensors: {unit: {unit: 3, sensor: a}}", "sensors.unit.unit: 3: must be text"),
        ("sensors: {a: {unit: '', sensor: a}}", "sensors.a.unit: must be text of 1 to 16"),
        ("sensors: {My range: {unit: m, sensor: a}}", "sensors.My range: a name has small letters"),
        (SEVENTEEN, "sensors: must have at most 16 entries"),
        ("motion: ./gone.py", "motion: ./gone.py: there is no such file"),
        ("hull_points: ./gone.py", "hull_points: ./gone.py: there is no such file"),
        ("hull: 0.3", "hull: unknown key; did you mean hull_m [m]?"),
    ],
)
def test_a_wrong_value_is_one_line_with_file_line_and_key(read, tmp_path, keys, message):
    with pytest.raises(BadInputError) as error:
        read(keys)
    assert f"{tmp_path}/robot.yaml:2: {message}" in str(error.value)
    assert "\n" not in str(error.value)


def test_a_planar_robot_does_not_land(read):
    with pytest.raises(BadInputError, match=r"guard\.stop is land, but a planar robot does not"):
        read("planar: true", "guard: {stop: land}")


@pytest.mark.parametrize(
    ("onboard", "key", "message"),
    [
        (
            "multirotor",
            "planar: true",
            "robot.yaml:2: planar: true: the onboard controller multirotor flies",
        ),
        ("{name: multirotor}", "planar: true", "delete planar, or choose diff_drive"),
        (
            "diff_drive",
            "planar: false",
            "robot.yaml:2: planar: false: the onboard controller diff_drive",
        ),
        ("diff_drive", "", "drives on the ground; set planar: true"),
    ],
)
def test_a_shipped_controller_that_does_not_fit_planar_is_refused_in_one_line(
    read, onboard, key, message
):
    with pytest.raises(BadInputError) as error:
        read(key, onboard=onboard)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_controller_of_the_users_may_fly_or_drive(read, tmp_path):
    (tmp_path / "own.py").touch()
    assert [read(f"planar: {flag}", onboard="./own.py").planar for flag in ("true", "false")] == [
        True,
        False,
    ]
