"""The error message of an experiment that cannot be loaded."""

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError


def refused(name, *settings):
    """Return the error message of an invalid experiment."""
    with pytest.raises(BadInputError) as caught:
        load_experiment(str(name), settings)
    assert caught.value.exit_code == 2
    return str(caught.value)
