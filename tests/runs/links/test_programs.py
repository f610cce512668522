"""How `cloudrc link exec` waits for its server, in virtual time."""

from types import SimpleNamespace

import pytest

from cloudrc.drivers.namespaces import ProgramState
from cloudrc.errors import TimedOutError
from cloudrc.runs.links import programs

NOWHERE, LOOPBACK, REACHABLE = [], [("127.0.0.1", 80)], [("0.0.0.0", 80)]


@pytest.fixture
def wait(monkeypatch):
    """Return a function that waits for a server, whose sockets a function of the time tells."""
    now = [100.0]

    def sleep(seconds):
        now[0] += seconds

    monkeypatch.setattr(programs, "time", SimpleNamespace(monotonic=lambda: now[0], sleep=sleep))

    def _wait(listens_at, limit):
        said = []
        server = SimpleNamespace(
            state=lambda: ProgramState(None, True, listens_at(now[0] - 100.0), 0)
        )
        run = programs._Run(None, said.append)
        try:
            run._wait_for_server(server, limit)
        except TimedOutError:
            said.append("timeout")
        return said

    return _wait


def test_the_wait_for_a_server_is_told_after_3_s_and_every_10_s(wait):
    said = wait(lambda at: REACHABLE if at > 25.0 else NOWHERE, 60.0)
    assert said == [
        f"waits until the server listens at a port ({at} of 60 s; --wait)" for at in (3, 13, 23)
    ]
    assert wait(lambda at: REACHABLE if at > 2.0 else NOWHERE, 60.0) == []


def test_the_wait_for_a_server_at_its_loopback_address_says_so(wait):
    note, *words, end = wait(lambda at: LOOPBACK, 14.5)
    assert "127.0.0.1" in note
    assert words == [
        f"waits until the server listens at another address ({at} of 14.5 s; --wait)"
        for at in (3, 13)
    ]
    assert end == "timeout"
