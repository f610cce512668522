"""`cloudrc faults`: what was flown before an interrupt is kept."""

import json

import pytest

from cloudrc.cli.pool import WorkerDiedError
from cloudrc.faults.measures import Outcome
from cloudrc.faults.schedule import Schedule
from cloudrc.faults.trial import Finding

KILLED = WorkerDiedError("a worker was killed")


@pytest.mark.parametrize(
    ("line", "error", "code", "said"),
    [
        ("search --jobs 2", KILLED, 6, "continue with 'cloudrc faults search --first 2'"),
        ("run --all", KILLED, 6, "cloudrc: a worker was killed; 1 of "),
        ("run --all", KeyboardInterrupt(), 130, "cloudrc: interrupted; 1 of "),
    ],
)
def test_what_was_flown_before_an_interrupt_is_kept(line, error, code, said, monkeypatch, call):
    def flown(function, work, jobs):
        seed = work[0][1] if "search" in line else 0
        yield Finding(Schedule(seed), ()) if seed else Outcome()
        raise error

    monkeypatch.setattr("cloudrc.cli.faults.map_in_order", flown)
    out, message = call(f"faults {line} -o json", code=code)
    document = json.loads(out)
    assert document.get("count") == 1 or len(document["faults"]) == 1
    assert said in message
    assert message.count("\n") == 1
