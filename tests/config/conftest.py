# SPDX-License-Identifier: Apache-2.0

"""The error message of an experiment that cannot be loaded; files that are read once."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.reuse import reuse_results
from cloudrc.config.load import load_experiment


def refused(name, *settings):
    """Return the error message of an invalid experiment."""
    with pytest.raises(BadInputError) as caught:
        load_experiment(str(name), settings)
    assert caught.value.exit_code == 2
    return str(caught.value)


def refused_line(name, *settings):
    """Return the error message, which is one line."""
    line = refused(name, *settings)
    assert "\n" not in line
    return line


@pytest.fixture
def files_are_read_once():
    """Let the loads of a test share what they read, as those of a sweep do: most of their time."""
    with reuse_results():
        yield
