# SPDX-License-Identifier: Apache-2.0

"""Errors for users."""

import pickle

from cloudrc.base.errors import ControllerLostError, DiskFullError, StateError


def test_an_error_keeps_its_cause_and_its_remedy_on_the_way_from_a_worker():
    error = pickle.loads(pickle.dumps(StateError("it stands; still", fix="push it; twice")))  # noqa: S301
    assert (error.cause, error.fix) == ("it stands; still", "push it; twice")
    assert str(error) == "it stands; still; push it; twice"
    assert str(StateError("it stands")) == "it stands"


def test_the_cause_of_an_error_with_a_code_is_its_text():
    for error in (ControllerLostError("silent", "no answer"), DiskFullError("here")):
        assert (error.cause, error.fix) == (str(error), "")
