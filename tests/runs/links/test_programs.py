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
        run = programs._Run(None, said.append, None)
        try:
            run._wait_for_server(server, limit)
        except TimedOutError:
            said.append("timeout")
        return said

    return _wait


@pytest.mark.parametrize(("place", "note"), [(NOWHERE, ""), (LOOPBACK, "only at 127.0.0.1:80")])
def test_a_server_that_does_not_listen_is_told_once(wait, place, note):
    said, end = wait(lambda at: place, 14.5)
    assert said.startswith("waits up to 14.5 s (--wait) until the server listens")
    assert note in said
    assert end == "timeout"
    assert wait(lambda at: REACHABLE if at > 2.0 else place, 60.0) == []
