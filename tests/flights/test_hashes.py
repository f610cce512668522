# SPDX-License-Identifier: Apache-2.0

"""Flights, evaluations and named faults record today what they recorded before, bit for bit."""

import platform

import pytest

from tests.conftest import nightly
from tests.flights.hashes import fly, read

LINES = {line["name"]: line for line in read()}
DAILY = "paper/paper-p2/1", "hover/lossy/2", "eval prefix lte", "fault F17"
HERE = platform.system(), platform.machine()


@pytest.mark.skipif(HERE != ("Linux", "x86_64"), reason="the hashes are those of one processor")
@pytest.mark.parametrize("name", [*DAILY, *nightly(*(each for each in LINES if each not in DAILY))])
def test_a_command_records_what_it_did(name, monkeypatch):
    monkeypatch.setattr("cloudrc.studies.eval.page.write_page", lambda *_: None)
    line = LINES[name]
    assert fly(line["command"]) == line["records_sha256"], "if this is meant: make hashes"


def test_all_kinds_of_records_are_kept():
    kinds = [line["command"].split()[:2] for line in LINES.values()]
    assert [kinds.count(kind) for kind in (["cloudrc", "run"], ["cloudrc", "eval"])] == [50, 10]
    assert sum(kind[0] == "pytest" for kind in kinds) == 24
