# SPDX-License-Identifier: Apache-2.0

"""The still picture: an obstacle hides the path behind it, and a short flight is drawn."""

from io import BytesIO

import numpy as np
from matplotlib.colors import to_rgb
from PIL import Image

from cloudrc.physics.geometry.shapes import Shapes, box
from cloudrc.results.report.figures import draw_still
from cloudrc.results.report.figures.still import TO_VIEWER
from cloudrc.results.report.figures.style import BLUE, Subject
from tests.results.metrics.conftest import OPEN_AIR, START, flown
from tests.results.report.test_marks import CALM, subject_of

MIDDLE = np.array([0.5, 0.0, 1.0])
"""A point of the path [m]."""


def seen(*places):
    """Return the number of pixels of the path among boxes at some places [m]."""
    log = flown(lambda seconds: (0.1 * seconds, 0.0, 1.0))
    boxes = [box((0.1, 0.1, 0.1)).placed(place, np.eye(3)) for place in places]
    subject = Subject(log.flight(OPEN_AIR), CALM, CALM, shapes=Shapes(scene=tuple(boxes)))
    pixels = np.asarray(Image.open(BytesIO(draw_still(subject).files["png"])).convert("RGB"))
    return int((np.abs(pixels - np.array(to_rgb(BLUE)) * 255).max(axis=2) < 2).sum())


def test_an_obstacle_in_front_hides_the_path_and_one_behind_does_not():
    assert seen(MIDDLE + TO_VIEWER) < 0.95 * seen(MIDDLE - TO_VIEWER)
    assert seen(MIDDLE - TO_VIEWER) == seen() > 100


def test_a_flight_of_one_sample_is_drawn():
    log = flown()
    log.keep(lambda stamp_ns: stamp_ns <= START)
    assert draw_still(subject_of(log=log)).files["png"]
