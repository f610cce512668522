# SPDX-License-Identifier: Apache-2.0

"""The shipped scene `pillars`: its bodies are obstacles, and a drone flies between them."""

import cloudrc


def test_a_drone_flies_the_slalom_through_the_pillars():
    flight = cloudrc.fly("steps", {"mission": "slalom", "world.scene": "pillars"})
    assert flight.verdict == "success"
    assert flight.numbers["waypoints_reached"] == 5
    assert flight.numbers["obstacle_contacts"] == 0
