# SPDX-License-Identifier: Apache-2.0

"""Fixtures of the faults: what the command line of the tests says."""

import pytest


@pytest.fixture
def fault_seed(pytestconfig):
    """Seed of a named fault's flights."""
    return pytestconfig.option.fault_seed
