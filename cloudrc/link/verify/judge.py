# SPDX-License-Identifier: Apache-2.0

"""Predict the measurement of a link with the requested profile, and judge a real measurement.

The random numbers of a relay depend only on seed and counter, so the delay of each datagram through
a relay can be predicted. The random numbers of netem cannot be predicted. Therefore 200 simulated
links with different seeds give a band of likely values for each quantity.

The verdict on a quantity is "ok" if the measured value is inside the band, widened by a tolerance,
and otherwise "off". It is "open" if the measurement is too short to decide, and "told" if a
requested property is only reported, not judged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan, nan, sqrt
from typing import NamedTuple

import numpy as np

from cloudrc.link.draws import Floats
from cloudrc.link.model import HEADER_BYTES, LinkDirection
from cloudrc.link.profile import DirectionProfile, GilbertElliott, LinkSchedule, mean_loss
from cloudrc.link.streams import Stream, numbers, sample

RUNS, RUN_LENGTH = 200, 1000
"""Number of simulated links for a band, and number of datagrams on each simulated link. The band is
scaled for measurements with another number of datagrams."""
ASKED_RUNS = 20  # number of simulated links for the values that a profile asks for
TAIL = 1e-3  # share of correct links below a band, and share above it, in [0, 1]
SAME_DELAYS, SAME_LOSSES = 0.5, 0.97
"""Limits above which a link counts as a relay with the predicted random numbers: correlation of
measured and predicted delays; share of datagrams whose loss or arrival was predicted."""
LAG = 3e-4  # longest time from sending a datagram to its arrival at the relay [s]
IN_SLOTS = 0.9  # least share of probes that a radio sends in the slots of its schedule, in [0, 1]
STILL, SHAPE_FLOOR = 1e-4, 2e-3
"""Standard deviations of the delay [s]. Below STILL, the correlation of delays is not used. Below
SHAPE_FLOOR, the distribution is not judged, because delays of the machine itself change it."""
TOLERANCES = {
    "mean": (2e-3, 0.05),
    "round_trip": (2e-3, 0.05),
    "deviation": (5e-4, 0.10),
    "distribution": (0.05, 0.0),
    "rate": (0.0, 0.25),
}
"""Quantity -> tolerance in the unit of the quantity, and tolerance as a share of the requested
value. The larger tolerance applies. For the deviation on a relay, half the share is used."""
SHARE_TOLERANCE = (0.02, 0.25)  # tolerance of a share: absolute, and relative to the request [1]
UNITS = {"mean": "s", "round_trip": "s", "deviation": "s", "rate": "bit/s"}
"""Quantity -> unit; quantities that are not listed are shares with the unit "1"."""
FEWEST, CHANCE_MAX = 300, 1.6
"""Smallest number of datagrams for a verdict, and largest half width of a band for the verdict
"ok", as a multiple of the tolerance."""


class Flow(NamedTuple):
    """The datagrams of one kind in one direction."""

    seed: int  # seed of the experiment
    uplink: bool
    kind: int  # as in the tunnel's header
    size: int  # UDP payload [bytes]
    stream: str = ""  # as in `LinkDirection`


class Judgement(NamedTuple):
    """Verdict on one quantity of one direction of a link; an unknown value is NaN.

    A `measured` value from `low` to `high` is accepted. `asked`, `measured`, `low` and `high` have
    the unit of the quantity (any unit).
    """

    name: str  # as in `Measurement.quantities`, or "round_trip"
    asked: float  # mean value of links with the requested profile
    measured: float
    low: float  # lowest accepted value
    high: float  # highest accepted value
    verdict: str  # "ok", "off", "open" or "told"

    @property
    def unit(self) -> str:
        """Unit of the quantity: "s", "1" or "bit/s"."""
        return UNITS.get(self.name, "1")


class Expected(NamedTuple):
    """The values that a measurement should give if the link has the requested profile."""

    bands: dict[str, tuple[float, float, float]]  # quantity -> mean, low and high limit of its band
    pooled: Floats  # delays minus the requested delays, with median 0, sorted [s]
    known: bool  # whether the random numbers are known, so that a band has no width

    def hidden(self, name: str) -> float:
        """Return how uncertain the expected value of quantity `name` is, relative to its tolerance.

        The result is half the width of the band of likely values, divided by the tolerance [1].
        Above CHANCE_MAX the verdict "ok" is impossible: the band would hide a deviation.
        """
        mean, low, high = self.bands[name]
        return 0.5 * (high - low) / tolerance(name, mean)

    def judge(self, name: str, value: float) -> Judgement:
        """Judge whether a correct link can give the `value` [any unit] of the quantity `name`."""
        mean, low, high = self.bands[name]
        slack, hidden = tolerance(name, mean), self.hidden(name)
        if self.known and name == "deviation":
            slack = max(TOLERANCES[name][0], 0.5 * slack)
        low, high = max(0.0, low - slack), high + slack
        verdict = "ok" if low <= value <= high else "off"
        if isnan(value) or (verdict == "ok" and hidden > CHANCE_MAX):
            verdict = "open"
        return Judgement(name, mean, value, low, high, verdict)


@dataclass(frozen=True)
class Measurement:
    """A measurement of one direction: the requested profile, and the datagrams to send.

    A train is a group of datagrams that are sent back to back to measure the rate. Before each
    train, the same number of datagrams is sent one by one to measure all other quantities.
    A simulation of the transfer calls `pause` every few hundred microseconds, so that other threads
    can run.
    """

    profile: DirectionProfile  # requested conditions
    flow: Flow
    sent: Floats  # time of sending of each datagram, since the link came up [s], shape (n,)
    train: int = 0  # number of datagrams in a train; 0 if there are no trains
    pause: Callable[[], None] = lambda: None

    def draw(self, sent: Floats, epoch: int = 1, first: int = 0) -> Stream:
        """Simulate the transfer of datagrams that are sent at `sent` [s] since the link came up.

        The counters of the datagrams begin at `first`, in the session `epoch`.
        """
        seed, uplink, kind, size, name = self.flow
        link = LinkDirection(self.profile, seed, uplink, stream=name)
        sent_ns = np.rint(sent * 1e9).astype(np.int64).tolist()
        stream = sample(link, kind, sent_ns, size, epoch=epoch, first=first, pause=self.pause)
        return replace(stream, sent=sent)

    @cached_property
    def links(self) -> list[Stream]:
        """Simulated streams through 200 netem links with different random numbers.

        They show how much correct links differ by chance. If the conditions are constant, a stream
        has at most RUN_LENGTH datagrams.
        """
        few = RUN_LENGTH - RUN_LENGTH % max(1, 2 * self.train)
        sent = self.sent[:few] if LinkSchedule(self.profile).only() else self.sent
        return replace(self, profile=netem_makes(self.profile))._simulated(RUNS, sent)

    def _simulated(self, count: int, sent: Floats) -> list[Stream]:
        seeds = range(-count, 0)  # the seed of an experiment is not negative
        return [replace(self, flow=self.flow._replace(seed=seed)).draw(sent) for seed in seeds]

    @cached_property
    def chance(self) -> Expected:
        """Expected quantities of a netem link; each band contains most of the simulated links."""
        return self._expect(self.links)

    def expected(self, measured: Stream, epoch: int = 1, first: int = 0) -> Expected:
        """Return the values that a correct link should give for the datagrams of a measured stream.

        If the delays or losses in the stream are those that a relay computes for the session
        `epoch`, the values are exact. Otherwise each value is a range, from simulations of the link
        with different seeds. `first` is the counter of the first datagram.
        """
        drawn = self._drawn(measured, epoch, first)
        if any(self._fits(self._singles(measured), self._singles(each)) for each in drawn):
            return self._expect(drawn)._replace(known=True)
        factor = sqrt(len(self.links[0].sent) / max(1, len(measured.sent)))
        bands = {
            name: (mean, mean - factor * (mean - low), mean + factor * (high - mean))
            for name, (mean, low, high) in self.chance.bands.items()
        }
        return self.chance._replace(bands=bands)

    def judge(self, measured: Stream, epoch: int = 1, first: int = 0) -> list[Judgement]:
        """Judge a measured stream; return one row per quantity.

        If the stream cannot show a requested property, such as the rate without trains, its row has
        only the requested value and the verdict "told". `first` is the counter of the first
        datagram in the session `epoch`.
        """
        return self._judge(measured, self.expected(measured, epoch, first))

    def _drawn(self, measured: Stream, epoch: int, first: int) -> list[Stream]:
        """Simulate what a relay does to the datagrams of a measured stream.

        A radio is simulated twice: as if they reached the relay when they were sent, and `LAG`
        later, which may be after the beginning of a slot.
        """
        drawn = [self.draw(measured.sent, epoch, first)]
        if self.profile.radio:
            later = self.draw(measured.sent + LAG, epoch, first)
            drawn.append(replace(later, sent=measured.sent, delays=later.delays + LAG))
        return drawn

    def judge_phase(self, measured: Stream, *, late: bool) -> list[Judgement]:
        """Judge the share of probes that a radio has sent in their slots; [] without a radio.

        On a machine that is `late`, the row only tells: probes reach the relay behind their slots.
        """
        if self.profile.radio is None:
            return []
        if late or len(measured.sent) < FEWEST:
            return [told("phase", 1.0)]
        off = [np.abs(measured.delays - each.delays) for each in self._drawn(measured, 1, 0)]
        least = np.minimum(*off)[np.isfinite(off[0])]
        share = float(np.mean(least < self.profile.radio.pattern_ns * 0.5e-9))
        verdict = "ok" if share >= IN_SLOTS else "off"
        return [Judgement("phase", 1.0, share, IN_SLOTS, 1.0, verdict)]

    def judge_applied(self, applied: Stream, measured: Stream) -> list[Judgement]:
        """Judge a measured stream by what the link has computed for the same packets."""
        return self._judge(measured, self._expect([applied]))

    def asked(self) -> dict[str, float]:
        """Return the mean quantities of links with other random numbers, by name."""
        expected = self._expect(self._simulated(ASKED_RUNS, self.sent))
        return {name: mean for name, (mean, _, _) in expected.bands.items()}

    def _judge(self, measured: Stream, expected: Expected) -> list[Judgement]:
        found = self.quantities(measured, expected.pooled)
        rows = [expected.judge(name, found[name]) for name in found if name in expected.bands]
        if len(measured.sent) < FEWEST:
            rows = [row._replace(verdict="open") for row in rows]
        if not expected.known and self.profile.jitter_ms and self.profile.correlation:
            rows.append(told("correlation", self.profile.correlation))
        if not self.train and self.profile.rate_kbit:
            rows.append(told("rate", self.profile.rate_kbit * 1e3))
        return rows

    def needed(self) -> int:
        """Return the number of datagrams that a verdict on every quantity needs."""
        most = max(map(self.chance.hidden, self.chance.bands))
        return round(len(self.links[0].sent) * max(1.0, most**2))

    def quantities(self, stream: Stream, pooled: Floats) -> dict[str, float]:
        """Compute the judged quantities of a stream by name; an unknown quantity is NaN.

        "deviation" is the standard deviation of (delay - requested delay) [s], so it shows the
        jitter alone. "distribution" is the Kolmogorov-Smirnov distance, in [0, 1], of these
        differences from `pooled`, the differences in simulated streams.
        """
        singles = self._singles(stream)
        found, shape = numbers(singles), self._shape(singles)
        measured = {
            "mean": found.mean,
            "deviation": float(shape.std()) if len(shape) else np.nan,
            "loss": found.loss,
            "reordered": found.overtaken,
            "duplicated": float((singles.copies > 1).sum()) / max(1, len(shape)),
        }
        if self.train:
            measured["rate"] = self._rate(stream)
        has_shape = not self.profile.radio  # of few different delays, which the phase judges
        if has_shape and len(shape) and len(pooled) and pooled.std() > SHAPE_FLOOR:
            points, steps = np.sort(shape), np.arange(len(shape) + 1) / len(shape)
            left, right = (np.searchsorted(pooled, points, side) for side in ("left", "right"))
            far = steps[1:] - left / len(pooled), right / len(pooled) - steps[:-1]
            measured["distribution"] = float(np.max(far))
        return measured

    def _fits(self, measured: Stream, drawn: Stream) -> bool:
        """Return whether the `measured` packets match the packets `drawn`.

        `drawn` are the same packets as simulated with the relay's random numbers. Compare the
        delays or, if the delays hardly vary, the losses.
        """
        lost = np.isnan(measured.delays), np.isnan(drawn.delays)
        both, requested = ~lost[0] & ~lost[1], _requested_delay(self.profile, drawn.sent)
        pair = [(one.delays - requested)[both] for one in (measured, drawn)]
        if both.any() and min(one.std() for one in pair) > STILL:
            return bool(np.corrcoef(pair[0], pair[1])[0, 1] > SAME_DELAYS)
        return bool(np.mean(lost[0] == lost[1]) > SAME_LOSSES)

    def _expect(self, links: Sequence[Stream]) -> Expected:
        pooled = np.sort(np.concatenate([self._shape(self._singles(link)) for link in links]))
        pooled = pooled[:: 1 + len(pooled) // 4096]
        found, bands = [self.quantities(link, pooled) for link in links], {}
        for name in found[0]:
            values = np.nan_to_num([one.get(name, np.nan) for one in found])
            low, high = np.quantile(values, (TAIL, 1.0 - TAIL)).tolist()
            bands[name] = (float(values.mean()), low, high)
        return Expected(bands, pooled, known=len(links) == 1)

    def _singles(self, stream: Stream) -> Stream:
        if not self.train:
            return stream
        parts = (stream.sent, stream.delays, stream.copies)
        return Stream(*(one.reshape(-1, 2 * self.train)[:, : self.train].ravel() for one in parts))

    def _shape(self, stream: Stream) -> Floats:
        """Return measured minus requested delay of arrived datagrams [s], shifted to median 0."""
        delays = stream.delays - _requested_delay(self.profile, stream.sent)
        there: Floats = delays[np.isfinite(delays)]
        return there - np.median(there) if len(there) else there

    def _rate(self, stream: Stream) -> float:
        """Compute the bottleneck's rate [bit/s] from the time that a probe train takes to arrive.

        Source: M. Jain, C. Dovrolis, IEEE/ACM Trans. Networking 12, 2004: packet dispersion.
        """
        arrival = (stream.sent + stream.delays).reshape(-1, 2 * self.train)[:, self.train :]
        arrival = arrival[np.isfinite(arrival).sum(axis=1) > self.train // 2]
        spans = np.nanmax(arrival, axis=1, initial=0.0) - np.nanmin(arrival, axis=1, initial=np.inf)
        bits = (self.train - 1) * (self.flow.size + HEADER_BYTES) * 8.0
        return float(bits / spans.mean()) if len(spans) and spans.mean() > 0.0 else np.nan


def _requested_delay(profile: DirectionProfile, sent: Floats) -> Floats:
    schedule = LinkSchedule(profile)
    if len(schedule.pieces) == 1:
        return np.full(len(sent), schedule.pieces[0].delay_ns * 1e-9)
    times = np.rint(sent * 1e9).astype(np.int64).tolist()
    return np.array([schedule.at(elapsed_ns).delay_ns for elapsed_ns in times]) * 1e-9


def netem_makes(profile: DirectionProfile) -> DirectionProfile:
    """Return a profile with which the relay's link model behaves as netem does with `profile`.

    netem hardly correlates delays. A packet that netem selects both for loss and for duplication
    arrives once. netem can also lose the copy of a duplicated packet.

    Source: Linux, net/sched/sch_netem.c.
    """
    loss, lost, single = profile.loss, mean_loss(profile.loss), 1.0 - profile.duplicate
    twice = profile.duplicate * (1.0 - lost) ** 2 / max(1e-9, 1.0 - single * lost)
    if isinstance(loss, GilbertElliott):
        kept = {"loss_bad": single * loss.loss_bad, "loss_good": single * loss.loss_good}
        loss = replace(loss, **kept)
    else:
        loss *= single
    return replace(profile, correlation=0.0, loss=loss, duplicate=twice)


def told(name: str, asked: float) -> Judgement:
    """Make a row that shows the requested value `asked` [unit of `name`] without a judgement."""
    return Judgement(name, asked, nan, nan, nan, "told")


def tolerance(name: str, asked: float) -> float:
    """Return the tolerance of the quantity `name`; `asked` is its requested value [its unit]."""
    floor, share = TOLERANCES.get(name, SHARE_TOLERANCE)
    return max(floor, share * asked)


def look_twice(first: Sequence[Judgement], second: Sequence[Judgement]) -> list[Judgement]:
    """Combine two measurements of a link: a quantity is "off" only if "off" in both."""
    again = {row.name: row for row in second}
    return [again.get(row.name, row) if row.verdict == "off" else row for row in first]
