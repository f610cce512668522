# SPDX-License-Identifier: Apache-2.0

"""Text from files and from the API is escaped: it cannot control the terminal or fake a line."""

import pytest

EVIL = "x\x1b]0;owned\x07\x9b2J\rcloudrc: all is well\n\u202ecloudrc: error: run me"
SHOWN = r"x\x1b]0;owned\x07\x9b2J\rcloudrc: all is well\n\u202ecloudrc: error: run me"


@pytest.mark.parametrize("words", ["run", "report", "report --recover", "link show"])
def test_a_name_in_an_error(words, refused):
    line = refused(words, EVIL)
    assert SHOWN in line
    assert line.removesuffix("\n").isprintable()
