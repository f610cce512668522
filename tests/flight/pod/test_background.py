# SPDX-License-Identifier: Apache-2.0

"""A slow perception in its thread delays no command."""

import threading

import pytest

from cloudrc.flight.pod.background import Background
from tests.conftest import wait_until


def outcome_of(worker):
    found = []
    wait_until(lambda: (one := worker.take()) and found.append(one) is None)
    return found[0]


def test_the_caller_goes_on_while_a_call_runs():
    gate, worker = threading.Event(), Background(None)
    worker.begin(gate.wait, 0)
    assert worker.take() is None
    gate.set()
    outcome = outcome_of(worker)
    assert (outcome.result, outcome.error) == (True, None)
    assert outcome.begun_ns <= outcome.done_ns
    assert worker.take() is None


def test_a_failure_comes_back_and_the_emulated_time_is_added():
    worker = Background(lambda began_ns: 10**12)

    def fail():
        raise ValueError("no wall")

    worker.begin(fail, 0)
    outcome = outcome_of(worker)
    assert outcome.done_ns - outcome.begun_ns >= 10**12
    with pytest.raises(ValueError, match="no wall"):
        raise outcome.error
