# SPDX-License-Identifier: Apache-2.0

"""Scans agree with distances computed by hand, and leave the flight alone."""

from math import cos, inf, pi, radians

import numpy as np
import pytest

from cloudrc.config.robot import ScanConfig
from cloudrc.config.shipped import file_of
from cloudrc.physics.geometry.rays import ranges_of
from cloudrc.physics.sim.engine import at_rest, mujoco
from cloudrc.physics.sim.scan import Scanner
from tests.world.conftest import model_of

LIDAR = -0.02, 0.0
"""Place of the rover's scanner [m], in its frame."""
WALL = '<body name="wall"><geom type="box" size=".5 20 2" pos="3.48 0 0" contype="0"/></body>'
"""Its front is at x = 2.98, 3 m before the scanner. A wall that nothing can touch is seen, too."""


@pytest.fixture
def walled(tmp_path):
    """Return a function that scans from the rover at a yaw [rad] in front of a wall."""
    path = tmp_path / "walled.xml"
    path.write_text(file_of("empty").read_text().replace("</worldbody>", f"{WALL}</worldbody>"))
    model = model_of("rover", str(path))

    def scan(yaw=0.0, seed=1, **keys):
        config = ScanConfig(**({"site": "lidar", "noise_m": 0.0} | keys))
        data = at_rest(model)
        data.qpos[3:7] = cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)
        scanner = Scanner(model, data, config, np.random.default_rng(seed))
        return scanner, ranges_of(scanner.measure(7).millimetres)

    return scan


def test_the_distance_of_a_wall_is_that_of_geometry(walled):
    scanner, ranges = walled()
    hit = np.abs(scanner.angles) < radians(70)  # farther to the side it is beyond 10 m
    assert ranges[hit] == pytest.approx(3.0 / np.cos(scanner.angles[hit]), abs=0.0006)
    assert (ranges[np.abs(scanner.angles) > radians(73)] == inf).all(), "range, and behind"


def test_a_turned_robot_sees_the_wall_where_it_is(walled):
    scanner, ranges = walled(yaw=pi / 4)
    x = 2.98 - LIDAR[0] * cos(pi / 4)  # the scanner turns about the base
    seen = scanner.angles + pi / 4
    hit = np.abs(seen) < radians(70)
    assert ranges[hit] == pytest.approx(x / np.cos(seen[hit]), abs=0.0006)


def test_angles_rise_to_the_left_over_both_ends():
    model = model_of("rover", "pillars")
    config = ScanConfig(site="lidar", rays=5, fov_deg=180.0, noise_m=0.0)
    data = at_rest(model)
    scanner = Scanner(model, data, config, np.random.default_rng(1))
    assert scanner.angles.tolist() == pytest.approx([-pi / 2, -pi / 4, 0.0, pi / 4, pi / 2])
    data.qpos[:2] = 5.5, 0.9  # 0.9 m left of pillar_3, with the lidar .02 behind
    right, _, ahead, _, left = ranges_of(scanner.measure(0).millimetres)
    assert right == pytest.approx(0.9 - (0.2**2 - 0.02**2) ** 0.5, abs=0.0006)
    assert (ahead, left) == (inf, inf)


def test_noise_has_its_deviation_and_its_seed(walled):
    _, first = walled(noise_m=0.05, rays=541, fov_deg=90.0)
    scanner, again = walled(noise_m=0.05, rays=541, fov_deg=90.0)
    assert (first == again).all()
    errors = first - 3.0 / np.cos(scanner.angles)
    assert abs(errors.mean()) < 4 * 0.05 / 541**0.5
    assert errors.std() == pytest.approx(0.05, rel=0.15)
    _, other = walled(noise_m=0.05, rays=541, fov_deg=90.0, seed=2)
    assert (first != other).any()


def test_a_scan_changes_no_bit_of_the_flight():
    model = model_of("rover", "pillars")
    data, alone = at_rest(model), at_rest(model)
    scanner = Scanner(model, data, ScanConfig(site="lidar"), np.random.default_rng(1))
    groups = model.geom_group.copy()
    for _ in range(50):
        scanner.measure(0)
        mujoco.mj_step(model, data)
        mujoco.mj_step(model, alone)
    assert (data.qpos == alone.qpos).all()
    assert (model.geom_group == groups).all()
