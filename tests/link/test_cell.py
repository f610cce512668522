# SPDX-License-Identifier: Apache-2.0

"""A cell serves the packets of many robots one after another."""

import numpy as np
import pytest

from cloudrc.link.cell import Bulk, Cell, CellPacket, CellQueue, Usage, Video
from cloudrc.link.model import HEADER_BYTES, LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.queue import NOTHING_NS
from cloudrc.link.waiting import md1, nddd1

MS = 1_000_000
RATE = 1e6
"""Rate at which a packet of 125 bytes takes 1 ms [bit/s]."""


def served(cell, *packets, until=1000 * MS):
    """Send packets, each a time [ms], a robot and perhaps a kind; return who left, and when."""
    for number, (at, flow, *kind) in enumerate(packets):
        cell.inbox.append(CellPacket(round(at * MS), 0, flow, number, *(kind or [0]), 125))
    return [(at_ns / MS, flow) for at_ns, flow, _ in cell.advance(until)]


def test_fifo_serves_in_the_order_of_sending_and_drops_what_finds_the_queue_full():
    cell = Cell(RATE, "fifo", packets_max=2)
    assert served(cell, (0, 1), (0, 0), (0.5, 2), (1, 3)) == [(1, 0), (2, 1), (3, 3)]
    assert cell.usage.dropped == {2: 1}
    assert (cell.usage.waited_ns, cell.usage.longest_ns) == (2 * MS, MS)


def test_a_packet_is_served_with_its_airtime():
    assert served(Cell(RATE, airtime_ns=MS // 2), (0, 0), (0, 1)) == [(1.5, 0), (3, 1)]


def test_drr_gives_each_robot_its_share_and_its_own_limit():
    cell = Cell(RATE, "drr", packets_max=40)
    greedy = [(0, 0)] * 60
    assert (2, 1) not in served(cell, *greedy, (0, 1), until=2 * MS)
    assert cell.usage.dropped == {0: 20}
    assert served(cell, until=14 * MS)[-2:] == [(13, 1), (14, 0)]  # after 1,500 bytes of robot 0


def test_priority_lets_robots_pass_the_traffic_of_others():
    cell = Cell(RATE, "priority")
    cell.traffic[-1] = Video(-1, 1e6, 0)
    left = served(cell, (0.1, 0), until=40 * MS)
    assert left == [(pytest.approx(1228 * 8e-3 + 1), 0)]


def test_newest_replaces_the_waiting_packet_of_the_same_robot_and_kind_alone():
    cell = Cell(RATE, "newest")
    left = served(cell, (0, 0), (0.1, 1, 7), (0.2, 2, 7), (0.3, 1, 8), (0.4, 1, 7))
    assert left == [(1, 0), (2, 1), (3, 2), (4, 1)]
    assert cell.usage.dropped == {1: 1}
    assert cell.usage.waited_ns == round((0.6 + 1.8 + 2.7) * MS)  # the newer one has the old place


def test_newest_keeps_every_packet_of_others():
    cell = Cell(RATE, "newest")
    assert served(cell, (0, -1), (0, -1), (0, -1), (0.1, 0), (0.2, 0)) == [(4, 0)]
    assert cell.usage.dropped == {0: 1}


def test_no_packet_arrives_before_the_soonest_time():
    cell = Cell(RATE, airtime_ns=MS)
    cell.delay_ns = 20 * MS
    shortest_ns = round(HEADER_BYTES * 8e3) + MS  # of an empty packet
    assert cell.soonest_ns(5 * MS) == 5 * MS + shortest_ns + 20 * MS
    served(cell, (6, 0), until=7 * MS)
    assert cell.soonest_ns(7 * MS) == (6 + 2 + 20) * MS


def test_the_usage_of_a_period_is_told_and_read_back():
    cell = Cell(RATE, "fifo", packets_max=3, direction="uplink")
    served(cell, (0, 0), (0, 1), (0, 2), (0.5, 2), until=10 * MS)
    told = cell.end_period(10 * MS)
    assert told == Usage("uplink", 0.01, 3, 375, 3 * MS, 3 * MS, 2 * MS, 2, {2: 1})
    assert Usage.read({key: str(value) for key, value in told.row().items()}) == told
    assert cell.usage == Usage("uplink")


@pytest.mark.parametrize(("rate", "packets"), [(1e6, 3), (1e3, 1)])
def test_a_frame_of_a_video_has_the_packets_of_its_rate(rate, packets):
    cell = Cell(1e9)
    cell.traffic[-1] = Video(-1, rate, 5 * MS)
    assert [*cell.advance(70 * MS)] == []  # frames at 5 and 38.3 ms
    assert (cell.usage.packets, cell.usage.size) == (2 * packets, 2 * packets * 1228)


@pytest.mark.parametrize(
    ("packets_max", "sent"),
    [
        # From 10 on, a packet more for each that is confirmed.
        (1000, [10, 10 + 20, 10 + 20 + 40]),
        # The sixth packet is dropped: half of 10, and then one more per round trip.
        (5, [5, 5 + 5, 5 + 5 + 6]),
    ],
)
def test_the_window_of_a_bulk_flow_grows_by_what_is_confirmed(packets_max, sent):
    cell, told = Cell(12e6, packets_max=packets_max), []  # a packet of 1,500 bytes takes 1 ms
    cell.traffic[-1] = Bulk(-1, 0)
    for until in (40, 81, 122):
        assert [*cell.advance(until * MS)] == []
        told.append(cell.usage.packets)
    assert told == sent


def cross(onward):
    """Send two packets of 1 ms through a cell and over links of 20 ms; return the robot's queue."""
    profile = DirectionProfile(delay_ms=20)
    links = [LinkDirection(profile, 1, uplink) for uplink in (True, False)]
    cell = Cell(RATE)
    queue = CellQueue(3, [cell], [False, False], links, onward)
    queue.watch = lambda *what: seen.append(what)
    seen = []
    for number, link in enumerate(links):
        queue.send(link, (7, 1, number), 125 - HEADER_BYTES, b"", 2 * MS)
    for at_ns, robot, leave in cell.advance(50 * MS):
        assert robot == 3
        leave(at_ns)
    assert cell.delay_ns == links[0].shortest_ns
    assert seen == [(True, (7, 1, 0), 2 * MS, 3 * MS), (False, (7, 1, 1), 2 * MS, 4 * MS)]
    return queue


def test_what_leaves_the_cell_is_in_flight_as_long_as_its_link_delays():
    queue = cross(None)
    assert queue.next_ns == 23 * MS


def test_what_leaves_the_cell_may_be_given_to_another_place():
    left = []
    queue = cross(lambda link, arrivals, data: left.append(arrivals))
    assert left == [(23 * MS,), (24 * MS,)]
    assert queue.next_ns == NOTHING_NS


def test_a_bulk_flow_fills_the_queue_and_halves_its_window_at_a_drop():
    cell = Cell(10e6, "fifo", packets_max=50)
    cell.traffic[-1] = Bulk(-1, 0)
    assert [*cell.advance(10_000 * MS)] == []
    assert cell.usage.busy_ns > 0.95 * 10_000 * MS
    assert 0 < cell.usage.dropped[-1] < 0.05 * cell.usage.packets


def test_equal_times_give_an_equal_order_whatever_the_order_of_the_inbox():
    packets = [(0, flow) for flow in range(5)]
    assert served(Cell(RATE), *packets) == served(Cell(RATE), *reversed(packets))


@pytest.mark.parametrize("senders", [3, 5])
def test_periodic_senders_wait_as_long_as_theory_says(senders):
    period, service = 10.0, 1.856  # of a packet of 232 bytes [ms]
    rng, means = np.random.default_rng(1), []
    for _ in range(800):
        cell, phases = Cell(RATE, packets_max=10**6), rng.integers(0, 10 * MS, senders)
        for n in range(3):
            cell.end_period(0)  # the last period counts
            at_ns = (phases + n * 10 * MS).tolist()
            cell.inbox = [CellPacket(at, 0, flow, n, 0, 232) for flow, at in enumerate(at_ns)]
            for _ in cell.advance((n + 1) * 10 * MS - 1):
                pass
        means.append(cell.usage.waited_ns / senders / MS)
    assert np.mean(means) == pytest.approx(nddd1(senders, period, service), rel=0.03)
    assert np.mean(means) < md1(senders * service / period, service) / 2


def test_theory_knows_the_published_numbers():
    assert nddd1(5, 10.0, 1.856) == pytest.approx(1.241, rel=2e-3)
    assert nddd1(1, 10.0, 1.856) == 0.0
    assert nddd1(6, 10.0, 1.856) == float("inf")
    assert md1(0.928, 1.856) == pytest.approx(11.96, rel=1e-3)
