# SPDX-License-Identifier: Apache-2.0

"""A schedule in a file breaks nothing: `pytest --schedule=FILE` flies what a search has stored."""

import pytest

from tests.faults.schedule import FaultEvent, Schedule, dump, load
from tests.faults.trial import fly

SHORT = Schedule(1, events=(FaultEvent("blackout", 2.0, 0.5),), duration=3.0)


@pytest.fixture
def file(pytestconfig, tmp_path):
    """File of the command line; otherwise a short one."""
    if pytestconfig.option.schedule is not None:
        return pytestconfig.option.schedule
    path = tmp_path / "short.yaml"
    path.write_text(dump(SHORT))
    return path


def test_the_schedule_of_a_file_breaks_nothing(file, record_property):
    found = fly(load(file), hashed=True)
    record_property("records_sha256", found.sha256)
    assert found.breaches == (), found.as_text()
    assert len(found.sha256) == 64
