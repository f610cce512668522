# SPDX-License-Identifier: Apache-2.0

"""The folder of a run, and the link to the newest one."""

import os
from contextlib import contextmanager

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import try_lock
from cloudrc.flight.folder import new_folder


def test_a_process_may_use_its_folder_again_until_something_is_in_it(tmp_path):
    """A notebook repeats a call that has failed."""
    out = tmp_path / "out"
    assert new_folder(out, "") == new_folder(out, "") == out
    (out / "config.yaml").touch()
    with pytest.raises(BadInputError, match="already exists"):
        new_folder(out, "")
    assert (out / "config.yaml").exists()


@pytest.mark.parametrize("is_there", [False, True])
def test_of_two_commands_at_the_same_time_one_gets_the_folder(is_there, tmp_path):
    out = tmp_path / "out"
    if is_there:
        out.mkdir()
    new_folder(out, "")
    with as_another_process(out) as is_free:
        assert not is_free
    new_folder(tmp_path / "next", "")
    with as_another_process(out) as is_free:
        assert is_free
        with pytest.raises(BadInputError, match="already exists"):
            new_folder(out, "")


@contextmanager
def as_another_process(folder):
    """Take a folder as another process does; tell whether it was free."""
    number = os.open(folder, os.O_RDONLY)
    try:
        yield try_lock(number)
    finally:
        os.close(number)
