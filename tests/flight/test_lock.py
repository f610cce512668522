# SPDX-License-Identifier: Apache-2.0

"""No flight is flown by two commands into one folder at the same time."""

from contextlib import nullcontext

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import lock_folder


@pytest.mark.parametrize(
    ("first", "second", "refused"),
    [
        (None, (1, 2), True),
        ((1, 2), (1, 2), True),
        ((1, 2), (2, 2), False),
    ],
)
def test_two_commands_never_fly_the_same_flights(first, second, refused, tmp_path):
    said = pytest.raises(BadInputError, match="another command flies into it now")
    with lock_folder(tmp_path, first), said if refused else nullcontext():
        with lock_folder(tmp_path, second):
            pass
    with lock_folder(tmp_path, second):  # the first command has ended
        pass
