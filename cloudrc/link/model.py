# SPDX-License-Identifier: Apache-2.0

"""Compute when each packet arrives in one direction of a link.

The model has no clock, no socket and no stateful random generator. Runs in virtual time and the
relay use the same model, so both get the same delays and losses.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, TypeAlias

from cloudrc.link.draws import BLOCK, OVERTAKES, Copies, bit_flips, impairments, stream_key
from cloudrc.link.profile import Conditions, DirectionProfile, LinkSchedule, Loss

if TYPE_CHECKING:
    from cloudrc.link.radio import RadioParts, Slots

Watch: TypeAlias = "Callable[[tuple[int, int, int], int, int, RadioParts | None], None]"
"""Is told of epoch, kind and counter of a packet, when it was sent [ns], its wait at the bottleneck
[ns], and the parts of its delay in the radio, if there is one."""
HEADER_BYTES = 28  # size of the IPv4 and UDP headers (RFC 791, RFC 768), also on the wire [bytes]
_BYTE = b"\0"  # stands for the content of a packet
_TABLES = 64  # number of blocks of impairments that are kept in memory


def enqueue(
    departures: deque[int], size: int, rate: float, packets_max: int, now_ns: int
) -> int | None:
    """Queue a packet at a bottleneck; return when it leaves [ns], or None if the queue is full.

    `departures`: when the packets before it leave [ns]; `size`: with its headers [bytes];
    `rate`: of the bottleneck [bit/s].
    """
    while departures and departures[0] <= now_ns:  # as in `_has_room`, without its call
        departures.popleft()
    if len(departures) >= packets_max:
        return None
    leaves_ns = (departures[-1] if departures else now_ns) + round(size * 8e9 / rate)
    departures.append(leaves_ns)
    return leaves_ns


def _has_room(departures: deque[int], packets_max: int, now_ns: int) -> bool:
    """Forget the packets that have left by `now_ns` [ns]; return whether one more may wait."""
    while departures and departures[0] <= now_ns:
        departures.popleft()
    return len(departures) < packets_max


class LinkDirection:
    """Model of one direction of the link.

    The random impairment of a packet depends only on seed, stream, direction, epoch, kind and
    counter. It
    does not depend on the order of calls, or on other datagrams.

    If the profile has a `rate` (a bottleneck with a queue) or `keep_order`, the arrival depends
    also on earlier packets. Then `send` must be called in the order of sending.

    Attributes:
        corrupts: Whether the link may damage datagrams; if true, call `corrupted` for each.
        blackouts: Number of packets that were lost because they were sent in a blackout.
        watch: Is called for each packet that waits at a bottleneck or in a radio, not for copies.
    """

    def __init__(
        self,
        profile: DirectionProfile,
        seed: int,
        uplink: bool,
        origin_ns: int = 0,
        *,
        stream: str = "",
    ) -> None:
        """Create the model; `uplink` is True for world to cloud.

        `origin_ns` is the start of the schedule [ns], on the clock of `now_ns` in `send`. Links
        with one seed and different names, `stream`, have different random numbers.
        """
        self._seed, self._uplink, self._stream = seed, uplink, stream
        self._origin_ns: int | None = origin_ns
        self._start_ns = 0
        self._departures: deque[int] = deque()
        self._last_release_ns = 0
        self.blackouts = 0
        self.watch: Watch | None = None
        self.replace_profile(profile)

    def replace_profile(
        self, profile: DirectionProfile, *, restart: bool = False, start_ns: int = 0
    ) -> None:
        """Replace the profile from the next packet on.

        Seed and the bottleneck's queue are kept. The random impairments are the same as if
        the link had used this profile from the start. With `restart`, the next packet is at
        `start_ns` of the new schedule; otherwise it starts at the same time as the old schedule.
        """
        if restart:
            self._origin_ns, self._start_ns = None, start_ns
        self.corrupts = profile.corrupt > 0.0
        self._profile = profile
        self._schedule = LinkSchedule(profile)
        self._only = self._schedule.only()
        times_ns, self._opportunities = profile.opportunities, None
        if times_ns:
            from cloudrc.link.opportunities import Opportunities  # here: few links need it

            self._opportunities = Opportunities(times_ns)
        self._radio: Slots | None = None
        if profile.radio:
            from cloudrc.link.radio import slots_of

            self._radio = slots_of(profile.radio, self._uplink)
        has_rate = times_ns or any(p.rate is not None for p in self._schedule.pieces)
        self._plain = not profile.keep_order and not has_rate and not profile.radio
        self._tables: dict[tuple[int, int, int, float, Loss], list[Copies]] = {}
        self._place: tuple[int, int, int, Conditions] | None = None

    def restart(self, origin_ns: int) -> None:
        """Begin as a new model does, at `origin_ns` [ns]; blocks that were drawn are kept."""
        self._origin_ns, self._start_ns = origin_ns, 0
        self._departures.clear()
        self._last_release_ns = self.blackouts = 0
        if self._opportunities is not None:
            self._opportunities.restart()

    def send(self, epoch: int, kind: int, counter: int, size: int, now_ns: int) -> Copies:
        """Send one packet of `size` bytes of UDP payload at `now_ns` [ns]; compute when it arrives.

        Epoch, kind and counter identify the packet. As in tc-netem, random losses occur before the
        bottleneck, and reordered packets skip the bottleneck.

        Returns:
            Times of arrival [ns], at or after `now_ns`: none for a lost packet, two for a
            duplicated packet. The second time is that of the copy, which may arrive first.
        """
        if self._origin_ns is None:
            self._origin_ns = now_ns - self._start_ns
        conditions = self._only or self._schedule.at(now_ns - self._origin_ns)
        if conditions.blackout:
            self.blackouts += 1
            return ()
        place = (epoch, kind, counter // BLOCK, conditions)
        if place != self._place:  # comparing takes less time than a look into the dictionary
            self._place, self._table = place, self._find_table(*place)
        copies = self._table[counter % BLOCK]
        if len(copies) == 1 and self._plain:  # nearly all packets: save time
            delay_ns = conditions.delay_ns + copies[0]
            return (now_ns + delay_ns if delay_ns > 0 else now_ns,)
        packet = epoch, kind, counter
        if len(copies) == 1:
            arrival = self._arrival(copies[0], conditions, size, now_ns, packet, 0)
            return () if arrival is None else (arrival,)
        arrivals = [
            self._arrival(entry, conditions, size, now_ns, packet, copy)
            for copy, entry in enumerate(copies)
        ]
        return tuple([arrival for arrival in arrivals if arrival is not None])

    def send_pieces(
        self, epoch: int, pieces: Iterable[tuple[int, int, int]], now_ns: int
    ) -> tuple[Copies, int]:
        """Send the packets of a message at `now_ns` [ns]: kind, counter and size [bytes] of each.

        A damaged packet is lost. Of two copies the first counts.

        Returns:
            When the last packet arrives [ns], no time if one is lost; and how many are lost.
        """
        whole_ns, lost = now_ns, 0
        for kind, counter, size in pieces:
            arrivals = self.send_checked(epoch, kind, counter, size, now_ns)
            if arrivals:
                whole_ns = max(whole_ns, min(arrivals))
            else:
                lost += 1
        return () if lost else (whole_ns,), lost

    def send_checked(self, epoch: int, kind: int, counter: int, size: int, now_ns: int) -> Copies:
        """Send a packet as `send` does; a damaged one is lost, as behind a checksum."""
        arrivals = self.send(epoch, kind, counter, size, now_ns)
        if arrivals and self.corrupts and self.corrupted(epoch, kind, counter, _BYTE) != _BYTE:
            return ()
        return arrivals

    @property
    def only(self) -> Conditions | None:
        """The conditions, if packets do not act on each other and the conditions never change."""
        return self._only if self._plain else None

    @property
    def shortest_ns(self) -> int:
        """A time that no packet's delay is below [ns]: the delay less the largest jitter.

        A radio adds the shortest time in it.
        """
        profile = self._profile
        least = -profile.quantiles[0] if profile.quantiles else 0.0
        spread = {"uniform": 1.0, "normal": 9.0, "pareto": 0.7, "table": least}
        below = spread[profile.distribution] * 1e9
        delays = (piece.delay_ns - below * piece.jitter for piece in self._schedule.pieces)
        air_ns = self._radio.span.least if self._radio else 0
        return 0 if profile.reorder else max(0, int(min(delays)) - 1) + air_ns

    def corrupted(self, epoch: int, kind: int, counter: int, data: bytes) -> bytes:
        """Return the content of a datagram as it arrives: unchanged, or with one bit flipped.

        Call this method only if `corrupts` is true. All copies of a packet have the same damage.

        Source: tc-netem(8), `corrupt`. Deviation: netem flips a bit anywhere in the frame, so the
        receiving kernel drops most damaged frames because their checksums are wrong. This model
        flips a bit of the datagram.
        """
        block, index = divmod(counter, BLOCK)
        key = stream_key(self._seed, self._uplink, epoch, kind, self._stream)
        place = bit_flips(key, block, self._profile.corrupt).get(index)
        if place is None or not data:
            return data
        bit = int(place * 8 * len(data))
        damaged = bytearray(data)
        damaged[bit >> 3] ^= 1 << (bit & 7)
        return bytes(damaged)

    def radio_parts(
        self, epoch: int, kind: int, counter: int, now_ns: int, copy: int = 0
    ) -> RadioParts | None:
        """Return the parts of the delay that a packet has in the radio; None without a radio.

        `now_ns` is when it enters the radio [ns]: when it is sent, or leaves the bottleneck. `copy`
        is 1 for the copy of a duplicated packet.
        """
        radio = self._profile.radio
        if self._radio is None or radio is None:
            return None
        from cloudrc.link.radio import phase_ns, repetitions

        block, index = divmod(counter, BLOCK)
        seed, uplink, stream = self._seed, self._uplink, self._stream
        repeats = repetitions(radio.error, seed, uplink, epoch, kind, stream, block, copy)[index]
        phase = phase_ns(radio, seed, uplink, epoch, stream)
        return self._radio.split(now_ns - (self._origin_ns or 0), phase, repeats)

    def _arrival(
        self,
        entry: int,
        conditions: Conditions,
        size: int,
        now_ns: int,
        packet: tuple[int, int, int],
        copy: int,
    ) -> int | None:
        """Compute when one copy of a packet arrives [ns]; None if the queue is full.

        `entry` is the extra delay of the copy [ns]; if it is OVERTAKES, the copy skips queue, radio
        and delay. `packet` has epoch, kind and counter.
        """
        arrival = now_ns
        if entry != OVERTAKES:
            departure: int | None = now_ns
            if conditions.rate is not None:
                most = self._profile.queue_packets
                size += HEADER_BYTES
                departure = enqueue(self._departures, size, conditions.rate, most, now_ns)
            elif self._opportunities is not None:
                departure = self._use_opportunity(size + HEADER_BYTES, now_ns)
            if departure is None:
                return None
            parts = self.radio_parts(*packet, departure, copy) if self._radio else None
            waited = departure > now_ns or parts is not None
            if waited and copy == 0 and self.watch is not None:
                self.watch(packet, now_ns, departure - now_ns, parts)
            arrival = departure
            if parts is not None:
                arrival += sum(parts)
            delay_ns = conditions.delay_ns + entry
            if delay_ns > 0:
                arrival += delay_ns
        if self._profile.keep_order:
            arrival = self._last_release_ns = max(arrival, self._last_release_ns)
        return arrival

    def _use_opportunity(self, size: int, now_ns: int) -> int | None:
        """Return when a packet of `size` bytes leaves the bottleneck [ns]; None: it is full."""
        departures, most = self._departures, self._profile.queue_packets
        assert self._opportunities is not None
        if not _has_room(departures, most, now_ns):
            return None
        origin_ns = self._origin_ns or 0
        departures.append(self._opportunities.leave_ns(size, now_ns - origin_ns) + origin_ns)
        return departures[-1]

    def _find_table(
        self, epoch: int, kind: int, block: int, conditions: Conditions
    ) -> list[Copies]:
        jitter, loss = conditions.jitter, conditions.loss
        key = (epoch, kind, block, jitter, loss)
        if key in self._tables:
            return self._tables[key]
        stream = stream_key(self._seed, self._uplink, epoch, kind, self._stream)
        if len(self._tables) >= _TABLES:
            del self._tables[next(iter(self._tables))]
        table = self._tables[key] = impairments(stream, block, self._profile, jitter, loss)
        return table
