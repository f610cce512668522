# SPDX-License-Identifier: Apache-2.0

"""A cell in real time: it serves the packets of all robots one after another."""

from time import monotonic_ns

from cloudrc.link.carry.cell import CellEngine
from cloudrc.link.carry.engine import LinkWay, Packet
from cloudrc.link.cell import Cell
from cloudrc.link.model import HEADER_BYTES, LinkDirection
from cloudrc.link.profile import DirectionProfile

SERVICE_NS = 1_000_000


class Given(list):
    """A port at which packets have come already."""

    def wait(self, until_ns):
        return True

    def take(self):
        while self:
            yield self.pop(0)


def carry(cells, packets, **profile):
    """Send packets of 1 ms on each way of two robots at once; return robot, times, data."""
    port, left = Given(), []
    engine, begin_ns = CellEngine(port, cells), monotonic_ns()

    def give(data):
        left.append((data[0], monotonic_ns() - begin_ns, data[1]))
        return True

    for robot in range(2):
        ways = []
        for uplink, name in ((True, "up"), (False, "down")):
            link = LinkDirection(DirectionProfile(**profile), 1, uplink, stream=str(robot))
            way = LinkWay(link, give)
            ways.append(way)
            port += [
                Packet(way, (5, 1, number), 125 - HEADER_BYTES, (robot, name), begin_ns)
                for number in range(packets)
            ]
        engine.join(robot, ways, (True, True))
    waited = sum(cell.service_ns(125) for cell in cells) * 4 * packets
    while len(left) < 4 * packets and monotonic_ns() < begin_ns + waited + 200_000_000:
        engine.step(0.001)
    assert engine.errors.early == 0
    return left


def test_two_robots_share_each_direction():
    left = carry([Cell(1e6), Cell(1e6)], 2)
    times = [at_ns for _, at_ns, data in left if data == "up"]
    assert all(at_ns >= (n + 1) * SERVICE_NS for n, at_ns in enumerate(times))
    assert [robot for robot, _, data in left if data == "down"] == [0, 0, 1, 1]


def test_one_medium_serves_both_directions():
    left = carry([Cell(1e6)], 1)
    assert [data for _, _, data in left] == ["up", "up", "down", "down"]
    assert left[-1][1] >= 4 * SERVICE_NS


def test_the_links_delay_follows_the_cell():
    left = carry([Cell(1e6), Cell(1e6)], 1, delay_ms=20)
    assert min(at_ns for _, at_ns, _ in left) >= 20_000_000 + SERVICE_NS


def test_what_a_link_loses_takes_no_place_in_the_cell():
    cells = [Cell(1e6), Cell(1e6)]
    assert not carry(cells, 1, loss=1.0)
    assert cells[0].usage.packets == 0
