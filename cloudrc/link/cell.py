# SPDX-License-Identifier: Apache-2.0

"""A radio cell: one medium that serves the packets of many robots one after another.

Which packet leaves next is decided when the packet before it has left. So the cell is no function
of one packet, as a bottleneck of a link is, but goes on with time, step by step: it gets all
packets sent before an instant, and tells which leave until this instant.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import partial
from math import inf
from typing import Any, Literal, NamedTuple

from cloudrc.link.model import HEADER_BYTES, LinkDirection
from cloudrc.link.queue import NOTHING_NS, PacketQueue

QUANTUM = 1500
"""What a robot may send in its turn with the queue drr [bytes].
Source: M. Shreedhar, G. Varghese, "Efficient fair queueing using deficit round robin", 1995."""
FRAME_NS, VIDEO_BYTES = 33_333_333, 1228
"""Time between two frames of a video [ns], and size of its packets with headers [bytes]."""
PICTURE = 10
"""Kind of the packets with fragments of a robot's pictures, `tunnel.codec.Kind.FRAME`."""
BULK_BYTES, ROUND_TRIP_NS, WINDOW_MAX = 1500, 40_000_000, 2000.0
"""Size of a packet of a bulk flow with headers [bytes]; time from its departure to its confirmation
[ns]; largest number of its packets under way."""


class CellPacket(NamedTuple):
    """A packet that is sent through a cell; packets of one instant keep the order of the fields."""

    sent_ns: int
    way: int  # 0: uplink, 1: downlink, 2: of others
    flow: int  # number of the robot; below 0: of others
    number: int  # of the packet in its flow
    kind: int
    size: int  # with headers [bytes]
    leave: Callable[[int], None] = lambda now_ns: None  # gets the time at which it leaves [ns]


@dataclass(slots=True)
class Usage:
    """What a cell has done within a period: a row of cell.csv."""

    direction: str  # "uplink" or "downlink"; "both" if they share the medium
    time_s: float = 0.0  # end of the period [s]
    packets: int = 0  # that began to leave
    size: int = 0  # of these [bytes]
    busy_ns: int = 0
    waited_ns: int = 0  # sum over all packets
    longest_ns: int = 0  # longest wait [ns]
    most: int = 0  # largest number of waiting packets
    dropped: dict[int, int] = field(default_factory=dict)  # robot, below 0: others -> packets

    def row(self) -> dict[str, Any]:
        """Return the row; its `dropped_by` has a pair ROBOT:PACKETS for each robot."""
        by = " ".join(f"{flow}:{count}" for flow, count in sorted(self.dropped.items()))
        row = {"time_s": self.time_s, **asdict(self)}
        return row | {"dropped": sum(self.dropped.values()), "dropped_by": by}

    @classmethod
    def read(cls, row: Mapping[str, str]) -> Usage:
        """Return what `row` has returned; raise a ValueError or KeyError for another row."""
        pairs = (pair.split(":") for pair in row["dropped_by"].split())
        counts: dict[str, Any] = {each.name: int(row[each.name]) for each in fields(cls)[2:-1]}
        dropped = {int(flow): int(count) for flow, count in pairs}
        return cls(row["direction"], float(row["time_s"]), **counts, dropped=dropped)


class Cell:
    """One direction of a cell, or both if they share the medium.

    Attributes:
        inbox: Packets that are sent, in any order, for the next `advance`.
        delay_ns: Shortest delay of a robot's packet behind the cell [ns].
        done_ns: When the packet in service leaves [ns]; `NOTHING_NS` if there is none.
        usage: Sums since the last `end_period`.
    """

    def __init__(
        self,
        rate: float,
        queue: Literal["fifo", "drr", "priority", "newest"] = "fifo",
        packets_max: int = 1000,
        airtime_ns: int = 0,
        direction: str = "both",
    ) -> None:
        """Create an idle cell of `rate` [bit/s]; `airtime_ns` is what each packet costs more [ns].

        `packets_max` is the size of a queue, with the packet in service. `direction` is that of
        its `Usage`.
        """
        self._rate, self._queue, self._packets_max = rate, queue, packets_max
        self._airtime_ns = airtime_ns
        self._lanes: dict[int, dict[Any, CellPacket]] = {}  # lane -> place -> packet, oldest first
        self._turns: dict[int, int] = {}  # of drr: lane -> what it may still send, first one first
        self._serving: CellPacket | None = None
        self._waiting = 0
        self.traffic: dict[int, Video | Bulk] = {}  # flow -> source
        self.inbox: list[CellPacket] = []
        self.delay_ns = self.done_ns = NOTHING_NS
        self.usage = Usage(direction)

    def end_period(self, now_ns: int) -> Usage:
        """Return what it has done since the last call; `now_ns` is the time [ns]."""
        done, self.usage = self.usage, Usage(self.usage.direction)
        done.time_s = now_ns / 1e9
        return done

    def service_ns(self, size: int) -> int:
        """Return how long the cell serves a packet of `size` [bytes], with headers."""
        return round(size * 8e9 / self._rate) + self._airtime_ns

    @property
    def next_ns(self) -> int:
        """Time of the next departure or of the next packet of others [ns]."""
        return min([self.done_ns, *(source.next_ns for source in self.traffic.values())])

    def soonest_ns(self, now_ns: int) -> int:
        """Return a time before which no packet arrives that leaves at `now_ns` or later [ns]."""
        if self._serving is not None:
            return self.done_ns + self.delay_ns
        return now_ns + max(1, self.service_ns(HEADER_BYTES) + self.delay_ns)

    def advance(self, until_ns: int) -> Iterable[tuple[int, int, Callable[[int], None]]]:
        """Take the packets sent before `until_ns` [ns].

        Yield time [ns], robot and `leave` of the packets that leave up to this time. At equal times
        packets leave first; then come new ones: by direction, robot and number, and at last those
        of others.
        """
        inbox, self.inbox = sorted(self.inbox, reverse=True), []
        while True:
            sent_ns = inbox[-1].sent_ns if inbox else NOTHING_NS
            other_ns, others = min(
                ((source.next_ns, -flow) for flow, source in self.traffic.items()),
                default=(NOTHING_NS, 0),
            )
            new_ns = min(sent_ns, other_ns)
            if self.done_ns <= new_ns and self.done_ns <= until_ns:
                now_ns, packet = self.done_ns, self._leave()
                if packet.flow >= 0:
                    yield now_ns, packet.flow, packet.leave
            elif new_ns >= until_ns:
                break
            elif sent_ns <= other_ns:
                self.put(inbox.pop())
            else:
                self.traffic[-others].fire(self)
        self.inbox += inbox  # what is sent later

    def put(self, packet: CellPacket) -> bool:
        """Let a packet wait; return False if it is dropped, because the queue is full."""
        flow, lane = packet.flow, self._lane(packet)
        waiting, dropped = self._lanes.setdefault(lane, {}), self.usage.dropped
        is_newest = self._queue == "newest" and flow >= 0 and packet.kind != PICTURE
        place = (flow, packet.kind, packet.way) if is_newest else (flow, packet.number)
        takes_place = place in waiting  # of an older packet
        is_full = not is_newest and len(waiting) + self._is_serving(lane) >= self._packets_max
        if takes_place or is_full:
            dropped[flow] = dropped.get(flow, 0) + 1
        if is_full:
            return False
        waiting[place] = packet
        self._waiting += not takes_place
        self.usage.most = max(self.usage.most, self._waiting)
        if self._queue == "drr":
            self._turns.setdefault(lane, QUANTUM)
        if self._serving is None:
            self._serve(packet.sent_ns)
        return True

    def _lane(self, packet: CellPacket) -> int:
        """Return the number of the queue in which a packet waits; lower ones leave first."""
        if self._queue == "drr":
            return packet.flow
        is_other = packet.flow < 0 or packet.kind == PICTURE
        return int(self._queue == "priority" and is_other)

    def _is_serving(self, lane: int) -> bool:
        return self._serving is not None and self._lane(self._serving) == lane

    def _leave(self) -> CellPacket:
        """Return the packet in service, which leaves, and serve the next one."""
        packet, now_ns = self._serving, self.done_ns
        assert packet is not None, "the cell serves a packet"
        self._serving, self.done_ns = None, NOTHING_NS
        self._serve(now_ns)
        if packet.flow < 0:
            packet.leave(now_ns)
        return packet

    def _serve(self, now_ns: int) -> None:
        """Begin to serve the next packet, if one waits."""
        lane = self._next_lane()
        if lane is None:
            return
        waiting, usage = self._lanes[lane], self.usage
        packet = self._serving = waiting.pop(next(iter(waiting)))
        self._waiting -= 1
        service_ns, wait_ns = self.service_ns(packet.size), now_ns - packet.sent_ns
        self.done_ns = now_ns + service_ns
        usage.packets += 1
        usage.size += packet.size
        usage.busy_ns += service_ns
        usage.waited_ns += wait_ns
        usage.longest_ns = max(usage.longest_ns, wait_ns)

    def _next_lane(self) -> int | None:
        """Return the queue from which the next packet leaves; None if nothing waits."""
        if self._queue != "drr":
            return next((lane for lane in sorted(self._lanes) if self._lanes[lane]), None)
        while self._turns:
            lane, rest = next(iter(self._turns.items()))
            waiting = self._lanes[lane]
            if waiting and (size := next(iter(waiting.values())).size) <= rest:
                self._turns[lane] -= size
                return lane
            del self._turns[lane]
            if waiting:  # its next turn comes after those of all others
                self._turns[lane] = rest + QUANTUM
        return None


class Video:
    """Frames of equal size at a constant rate, cut into packets; it does not react to losses."""

    def __init__(self, flow: int, rate: float, start_ns: int) -> None:
        """Set the mean `rate` [bit/s] and the time of the first frame [ns]."""
        self._flow, self._sent, self.next_ns = flow, 0, start_ns
        self._packets = max(1, round(rate * FRAME_NS / 8e9 / VIDEO_BYTES))

    def fire(self, cell: Cell) -> None:
        """Send a frame."""
        for _ in range(self._packets):
            self._sent += 1
            cell.put(CellPacket(self.next_ns, 2, self._flow, self._sent, 0, VIDEO_BYTES))
        self.next_ns += FRAME_NS


class Bulk:
    """A flow that fills the queue: its window grows until a drop, and then becomes half as large.

    It is no TCP: the window grows by one packet per confirmed packet up to the first drop and then
    by one per round trip. Nothing is sent again, and confirmations neither queue nor get lost.
    """

    def __init__(self, flow: int, start_ns: int) -> None:
        """Set the time of the first packet [ns]."""
        self._flow, self._sent, self.next_ns = flow, 0, start_ns
        self._window, self._flying, self._threshold, self._halved_ns = 10.0, 0, inf, -1
        self._confirmed = deque[int]()

    def fire(self, cell: Cell) -> None:
        """Take the confirmations that are due, and send as many packets as the window allows."""
        now_ns = self.next_ns
        while self._confirmed and self._confirmed[0] <= now_ns:
            self._confirmed.popleft()
            self._flying -= 1
            growth = 1.0 if self._window < self._threshold else 1.0 / self._window
            self._window = min(WINDOW_MAX, self._window + growth)
        self.next_ns = self._confirmed[0] if self._confirmed else now_ns + ROUND_TRIP_NS
        while self._flying < int(self._window):
            self._sent += 1
            what = self._flow, self._sent, 0, BULK_BYTES, self._leave
            if not cell.put(CellPacket(now_ns, 2, *what)):
                if now_ns > self._halved_ns:
                    self._window = self._threshold = max(2.0, self._window / 2)
                    self._halved_ns = now_ns + ROUND_TRIP_NS
                return
            self._flying += 1

    def _leave(self, now_ns: int) -> None:
        """Expect the confirmation of a packet that has left at `now_ns` [ns]."""
        self._confirmed.append(now_ns + ROUND_TRIP_NS)
        self.next_ns = min(self.next_ns, self._confirmed[0])


class CellQueue(PacketQueue):
    """The packets of a robot in flight behind a cell; new ones are sent through the cell."""

    def __init__(
        self,
        robot: int,
        cells: Sequence[Cell],
        orders: Sequence[bool],
        links: Sequence[LinkDirection],
        onward: Callable[[LinkDirection, Sequence[int], Any], None] | None = None,
    ) -> None:
        """Set the robot's number; the cells of uplink and downlink, or the one of both.

        `orders` tells which of the `links` keep the order. `onward` gets what leaves the cell, as
        `put` does by default.
        """
        super().__init__()
        self._robot, self._cells, self._orders = robot, (*cells, *cells)[:2], orders
        self._downlink, self._onward = links[1], onward or self.put
        self._last_ns, self._numbers = [0, 0], 0
        for cell, link in zip(self._cells, links, strict=True):
            cell.delay_ns = min(cell.delay_ns, link.shortest_ns)

    def send(
        self, link: LinkDirection, header: tuple[int, int, int], size: int, data: Any, now_ns: int
    ) -> None:
        """Send a packet through the cell, unless the link loses it; each copy takes its place."""
        kind, epoch, counter = header
        arrivals = link.send(epoch, kind, counter, size, now_ns)
        if arrivals and link.corrupts:
            data = link.corrupted(epoch, kind, counter, data)
        way = int(link is self._downlink)
        for arrival_ns in arrivals:
            self._numbers += 1
            sent = header, now_ns
            leave = partial(self._leave, way, link, data, arrival_ns - now_ns, sent)
            what = self._robot, self._numbers, kind, size + HEADER_BYTES, leave
            self._cells[way].inbox.append(CellPacket(now_ns, way, *what))

    def _leave(
        self,
        way: int,
        link: LinkDirection,
        data: Any,
        delay_ns: int,
        sent: tuple[tuple[int, int, int], int],
        now_ns: int,
    ) -> None:
        """Take a packet that has left the cell at `now_ns` [ns]; `sent` is its header, and when."""
        if self.watch is not None:
            self.watch(way == 0, *sent, now_ns)
        arrival_ns = now_ns + delay_ns
        if self._orders[way]:
            arrival_ns = self._last_ns[way] = max(arrival_ns, self._last_ns[way])
        self._onward(link, (arrival_ns,), data)
