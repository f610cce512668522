"""A direction of a TCP connection over the link, in virtual time."""

import hashlib
import random
from itertools import pairwise

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.queue import NOTHING_NS
from cloudrc.link.relay_tcp.agenda import Agenda
from cloudrc.link.relay_tcp.congestion import Cubic, SentSegment
from cloudrc.link.relay_tcp.medium import SEGMENT, Medium, refuse_unsupported
from cloudrc.link.relay_tcp.stream import READ_AHEAD, WINDOW_BYTES, LinkStream
from tests.link.profiles import blackout, changed, in_bursts, profile_of

MS = 1_000_000
PLAIN = profile_of(0.040)


class Far:
    """The far end of a stream: it takes all bytes at once, or none."""

    def __init__(self, up, down=None, *, start_ns=0, takes=True, seed=1):
        self.agenda, self.bytes, self.times, self.end_ns = Agenda(), bytearray(), [], None
        self.takes = takes
        ways = Medium(up, seed, True, 0), Medium(down or up, seed, False, 0)
        self.up = ways[0]
        self.stream = LinkStream(self.agenda, ways, 1, self.deliver)
        self.stream.open(start_ns, 80 * MS)

    def deliver(self, data, now_ns):
        assert self.end_ns is None
        if not data:
            self.end_ns = now_ns
            return
        self.bytes += data
        self.times.append(now_ns)
        if self.takes:
            self.agenda.at(now_ns, self.stream.taken, len(data))

    def send(self, data, now_ns=0):
        """Send bytes as the stream takes them; return when the last one arrives [ms]."""
        began, sent = now_ns, 0
        wanted = len(self.bytes) + len(data)
        while True:
            if sent < len(data) and (room := self.stream.room):
                self.stream.write(data[sent : sent + room], now_ns)
                sent += room
            elif self.agenda.next_ns != NOTHING_NS and len(self.bytes) < wanted:
                now_ns = self.agenda.next_ns
                self.agenda.run(now_ns)
            else:
                return (self.times[-1] - began) / MS


@pytest.mark.parametrize(
    ("size", "trips"), [(200, 0), (10 * SEGMENT, 0), (11 * SEGMENT, 1), (70 * SEGMENT, 2)]
)
def test_a_new_connection_begins_slowly(size, trips):
    """Windows of 10, 20, 40 segments: one round trip of 80 ms for each further one."""
    assert Far(PLAIN).send(bytes(size)) == pytest.approx(40 + 80 * trips, abs=0.01)


def test_a_used_connection_has_its_window():
    far = Far(PLAIN)
    far.send(bytes(200_000))
    now_ns = far.times[-1] + 50 * MS
    far.agenda.run(now_ns)
    assert far.send(bytes(60_000), now_ns) == pytest.approx(40)


def test_a_pause_shrinks_the_window():
    far = Far(PLAIN)
    far.send(bytes(2_000_000))
    far.agenda.run(60_000 * MS)
    assert far.send(bytes(60_000), 60_000 * MS) > 100


def test_nothing_is_sent_before_the_connection_is_open():
    assert Far(PLAIN, start_ns=80 * MS).send(b"x") == pytest.approx(120)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "profile",
    [
        profile_of(0.040, 0.020, loss=0.05),
        profile_of(0.010, loss=in_bursts(0.02, 0.3)),
        profile_of(0.005, rate=2_000_000.0, queue_packets=10),
        profile_of(0.020, blackouts=(blackout(0.05, 0.7),)),
    ],
)
def test_all_bytes_arrive_once_and_in_order(profile, seed):
    data = random.Random(seed).randbytes(700_000)
    far = Far(profile, seed=seed)
    far.send(data)
    far.stream.write(b"", 60_000 * MS)
    far.agenda.run(90_000 * MS)
    assert hashlib.sha256(far.bytes).digest() == hashlib.sha256(data).digest()
    assert far.end_ns is not None


@pytest.mark.full
def test_a_million_segments_arrive_once_and_in_order():
    far = Far(profile_of(0.001, loss=0.0001))
    sent, found, source, now_ns = hashlib.sha256(), hashlib.sha256(), random.Random(1), 0
    for _ in range(1_000):
        data = source.randbytes(1_000 * SEGMENT)
        sent.update(data)
        now_ns += round(far.send(data, now_ns) * MS)
        found.update(far.bytes)
        far.bytes.clear()
        far.times.clear()
    assert found.digest() == sent.digest()


def test_a_lost_segment_costs_one_round_trip_if_later_ones_arrive():
    """The first segment is lost: the third later one that arrives shows the gap."""
    profile = changed(PLAIN, blackouts=(blackout(0.0, 0.0005),))
    far = Far(profile)
    far.stream.write(bytes(SEGMENT), 0)
    far.agenda.run(1 * MS)
    far.stream.write(bytes(8 * SEGMENT), 1 * MS)
    far.agenda.run(5_000 * MS)
    assert far.times[-1] == pytest.approx(1 * MS + (80 + 40) * MS, abs=25 * MS)


def test_a_lost_single_segment_waits_for_a_time_out():
    profile = changed(PLAIN, blackouts=(blackout(1.0, 0.01),))
    far = Far(profile)
    far.send(b"x")
    far.agenda.run(1_000 * MS)
    took = far.send(b"y", 1_000 * MS)
    assert 240 <= took <= 400


def test_a_new_connection_knows_the_round_trip_when_its_first_segment_is_lost():
    """The handshake has measured it, so the stream waits 80 + 200 ms, and not one second."""
    far = Far(changed(PLAIN, blackouts=(blackout(0.0, 0.01),)))
    assert far.send(b"x") == pytest.approx(280 + 40)


def test_a_loss_soon_after_time_outs_does_not_wait_for_their_longer_deadline():
    """A message arrives at 1.16 s, in its third attempt; the next one is lost at 1.21 s."""
    far = Far(changed(PLAIN, blackouts=(blackout(0.0, 1.0), blackout(1.205, 0.01))))
    assert far.send(b"x") == pytest.approx(1160)
    far.agenda.run(1_210 * MS)
    assert far.send(b"y", 1_210 * MS) == pytest.approx(280 + 40)


def test_losses_do_not_depend_on_how_the_bytes_are_cut():
    data, found = bytes(200_000), []
    for size in (777, 65_536):
        far = Far(profile_of(0.010, loss=0.05))
        now_ns = 0
        for at in range(0, len(data), size):
            far.stream.write(data[at : at + size], now_ns)
        far.agenda.run(60_000 * MS)
        assert len(far.bytes) == len(data)
        medium = far.up
        found.append([medium.cross(1, place, 1, 100, 90_000 * MS) is None for place in range(138)])
    assert found[0] == found[1]
    assert 0 < sum(found[0]) < 20


def test_messages_one_after_the_other_have_losses_of_their_own():
    """Seven of them fit into one segment, but they are seven packets."""
    far, took, now_ns = Far(profile_of(0.010, loss=0.2)), [], 0
    for _ in range(200):
        took.append(far.send(bytes(200), now_ns))
        now_ns = far.times[-1] + 20 * MS
        far.agenda.run(now_ns)
    lost = [time > 11 for time in took]
    runs = sum(one != other for one, other in pairwise(lost))
    assert 20 <= sum(lost) <= 60
    assert runs > 1.2 * sum(lost)  # independent: 1.6; seven at a time: .3


def test_round_trips_that_get_longer_end_the_slow_start_of_cubic():
    """A queue fills: with 8 round trips longer by an eighth, the window doubles no more."""
    window, now_ns = Cubic(), 0
    for trip_ms in (80, 80, 91, 91):
        for number in range(int(window.window)):
            now_ns += 3 * MS  # no train: its gaps are below 2 ms
            sent = SentSegment(now_ns - trip_ms * MS)
            sent.new_round = not number
            window.acknowledged(sent, 1, now_ns, int(window.window))
    assert 40 < window.window < 60


def test_cubic_comes_back_to_the_window_of_the_last_loss():
    window, now_ns = Cubic(), 0
    window.window = 100.0
    window.lost(now_ns)
    assert window.window == 70
    sizes = []
    for _ in range(100):
        now_ns += 80 * MS
        for _ in range(int(window.window)):
            sent = SentSegment(now_ns - 80 * MS)
            window.acknowledged(sent, 1, now_ns, int(window.window))
        sizes.append(window.window)
    assert sizes[10] - 70 > 2 * (sizes[48] - sizes[38])  # steep, then flat around 100
    assert sizes[48] == pytest.approx(100, abs=4)
    assert sizes[99] > 120


def test_after_a_time_out_the_window_opens_anew():
    """A whole window is lost, its probe, too, and a first try: 1, 2, 4, 8 are sent at a time."""
    far = Far(changed(PLAIN, blackouts=(blackout(0.5, 1.2),)))
    far.send(bytes(60 * SEGMENT))
    far.agenda.run(500 * MS)
    far.times.clear()
    far.send(bytes(20 * SEGMENT), 510 * MS)
    assert [far.times.count(time) for time in sorted(set(far.times))] == [1, 2, 4, 8, 5]


def test_a_loss_ends_slow_start_where_it_is_found():
    """Of a window of 40 the middle is lost: 20 acknowledgements open the window before, not 40."""
    far = Far(changed(PLAIN, blackouts=(blackout(0.16001, 0.0000001),)))
    far.send(bytes(30 * SEGMENT))
    far.agenda.run(160 * MS)
    far.stream.write(bytes(20 * SEGMENT), 160 * MS)
    far.agenda.run(160 * MS + 10_000)
    far.stream.write(bytes(SEGMENT), 160 * MS + 10_050)
    far.stream.write(bytes(19 * SEGMENT), 161 * MS)
    far.agenda.run(300 * MS)
    assert far.stream._congestion.window == pytest.approx(0.7 * 60, abs=2)


def test_a_new_receiver_has_room_for_64_kib():
    """The fourth window has less than 80 segments."""
    far = Far(PLAIN)
    far.send(bytes(400_000))
    counts = [far.times.count(time) for time in sorted(set(far.times))]
    assert counts[:3] == [10, 20, 40]
    assert 70 <= counts[3] < 80


def test_jitter_depends_on_the_time_alone():
    medium = Medium(profile_of(0.040, 0.020), 1, True, 0)
    slots = [slot * 10 * MS for slot in range(200)]
    delays = [medium.arrival_ns(now_ns) - now_ns for now_ns in slots]
    assert len(set(delays)) > 150
    assert medium.arrival_ns(19 * MS) - 19 * MS == delays[1]
    assert min(delays) >= 20 * MS
    assert max(delays) <= 60 * MS


def test_a_link_that_keeps_the_order_delays_each_packet_by_itself():
    """A late packet holds up all behind it, also those of other connections."""
    medium = Medium(profile_of(0.040, 0.020, keep_order=True), 1, True, 0)
    times = [medium.cross(number % 3, number, 1, 100, 0) for number in range(100)]
    assert times == sorted(times)
    assert 5 < len(set(times)) < 30
    assert times[-1] > 58 * MS


def test_connections_share_one_bottleneck():
    medium = Medium(profile_of(0.0, rate=1_200_000.0), 1, True, 0)
    first, second = (medium.cross(number, 0, 1, 1448, 0) for number in (1, 2))
    assert (first, second) == (10 * MS, 20 * MS)


def test_a_receiver_that_stops_ends_the_sending_of_more_bytes():
    far = Far(PLAIN, takes=False)
    taken = 0
    for turn in range(4000):
        if room := far.stream.room:
            far.stream.write(bytes(room), turn * 10 * MS)
            taken += room
        far.agenda.run((turn + 1) * 10 * MS)
    assert len(far.bytes) <= WINDOW_BYTES + SEGMENT
    assert taken <= WINDOW_BYTES + READ_AHEAD + SEGMENT
    assert far.stream.room == 0


def test_a_change_of_the_profile_acts_on_an_open_connection():
    far = Far(PLAIN)
    far.send(b"x")
    far.up.replace_profile(profile_of(0.100))
    assert far.send(b"y", 1_000 * MS) == pytest.approx(100)


def test_a_perfect_link_hands_on_at_once():
    far = Far(profile_of(0.0))
    assert far.send(bytes(1_000_000)) == 0.0


@pytest.mark.parametrize("key", ["duplicate", "corrupt", "reorder"])
def test_what_a_stream_of_bytes_cannot_show_is_refused(key):
    with pytest.raises(BadInputError, match=rf"uplink.{key}: .*link exec"):
        refuse_unsupported(profile_of(0.040, **{key: 0.01}), "uplink")
