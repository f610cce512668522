# SPDX-License-Identifier: Apache-2.0

"""Drive with the perception beside this file, in virtual time; pytest runs it."""

from pathlib import Path

import cloudrc

PERCEPTION = str(Path(__file__).with_name("perception.py"))


def test_the_robot_drives_by_what_it_sees() -> None:
    """The rover passes the pillars of a corridor."""
    flight = cloudrc.fly("gap", {"cloud.perception": PERCEPTION})
    assert flight.verdict == "success", flight
