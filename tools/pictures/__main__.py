# SPDX-License-Identifier: Apache-2.0

"""Draw the pictures of the documentation: `make pictures`."""

from __future__ import annotations

from tools.guests import DOCS
from tools.pictures.arm import draw_arm
from tools.pictures.film import make_film
from tools.pictures.stills import draw_missions, draw_robots

draw_robots()
draw_missions()
make_film(DOCS / "two-flights.webp")
draw_arm(DOCS / "meta-world.png")
