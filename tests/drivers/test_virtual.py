"""The run in virtual time hands datagrams to the link."""

from collections import Counter
from types import SimpleNamespace

import pytest

from cloudrc.drivers.virtual import VirtualRun
from cloudrc.messages import ZERO, Command
from cloudrc.tunnel.codec import PLAN_MAX, Direction, Kind
from cloudrc.tunnel.end import Identity, TunnelEnd
from tests.flights.conftest import CLOCK, ring


class Link:
    """A link that notes the sizes of the datagrams, and loses them."""

    corrupts = False

    def __init__(self):
        self.sizes = []

    def send(self, epoch, kind, counter, size, now_ns):
        self.sizes.append(size)
        return ()


def endpoint(deadline_ns, datagrams=()):
    """Make an endpoint with one deadline, at which it sends `datagrams`."""
    deadlines = iter([deadline_ns])
    return SimpleNamespace(
        next_deadline_ns=lambda: next(deadlines, 1 << 62),
        handle_deadline=lambda now_ns: None,
        take_datagrams=lambda: list(datagrams),
        take_records=list,
    )


@pytest.mark.parametrize("planned", [0, 1, PLAN_MAX])
def test_a_command_loads_the_link_as_its_bytes_would(planned):
    sizes = []
    for passes in (False, True):
        identity = Identity(CLOCK, bytes(16), ring(), passes)
        end = TunnelEnd(identity, Direction.DOWNLINK, Counter(), newest_wins=True)
        end._session.begin(1, bytes(32))
        end._send_message(Kind.COMMAND, Command(1, 2, 3, ZERO, 0.0, (ZERO,) * planned, 4))
        downlink = Link()
        run = VirtualRun(endpoint(1 << 62), endpoint(5, end.take_datagrams()), Link(), downlink)
        run.fly(lambda: False, 10, lambda of_world, of_cloud: None)
        sizes.append(downlink.sizes)
    assert sizes[0] == sizes[1]
