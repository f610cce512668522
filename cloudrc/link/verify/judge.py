"""Predict what the datagrams of one direction measure, and judge what they did measure.

The random numbers of a relay depend only on seed and counter, so the delay of each datagram on a
relay can be predicted. netem has random numbers of its own. For netem, 200 links with other seeds
are simulated; they give a band for each quantity. A row is "ok" within the band, widened by a
tolerance, and otherwise "off". A row is "open" if chance could hide a wrong link, and "told" if the
profile requests something that was not judged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan, nan, sqrt
from typing import NamedTuple

import numpy as np

from cloudrc.link.draws import Floats
from cloudrc.link.model import HEADER_BYTES, LinkDirection, Stream, numbers
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Timeline, mean_loss

RUNS, RUN_LENGTH = 200, 1000
"""Simulated links for a band, and datagrams of each; for other numbers a band is scaled."""
TAIL = 1e-3
"""Share of honest links below a band, and share of them above it."""
SAME_DELAYS, SAME_LOSSES = 0.5, 0.97
"""Least correlation of measured and predicted delays, and least share of datagrams whose loss or
arrival was predicted, from which on the link counts as a relay with known random numbers."""
STILL, SHAPE_FLOOR = 1e-4, 2e-3
"""Standard deviations of the delay [s]. Below the first, a correlation of delays means nothing;
below the second, the machine itself changes the shape of the distribution."""
TOLERANCES = {
    "mean": (2e-3, 0.05),
    "round_trip": (2e-3, 0.05),
    "deviation": (5e-4, 0.10),
    "distribution": (0.05, 0.0),
    "rate": (0.0, 0.25),
}
"""Quantity -> tolerance in its unit, and as a share of the requested value: the larger counts.
On a relay, the share of the deviation is half of that."""
SHARE_TOLERANCE = (0.02, 0.25)
"""Tolerance of loss, order and copies: absolute, and as a share of the requested value."""
UNITS = {"mean": "s", "round_trip": "s", "deviation": "s", "rate": "bit/s"}
"""Quantity -> unit; that of a share is "1"."""
FEWEST, CHANCE_MAX = 300, 1.6
"""Fewest datagrams for a verdict; widest half of a band for "ok", in tolerances."""


class Flow(NamedTuple):
    """Datagrams of one kind in one direction."""

    seed: int  # of the experiment
    uplink: bool
    kind: int  # as in the tunnel's header
    size: int  # UDP payload [bytes]


class Row(NamedTuple):
    """One quantity of one direction; an unknown value is NaN.

    The values asked, measured, low and high have the unit `unit`, so any unit.
    """

    name: str  # as in `Plan.quantities`, or "round_trip"
    unit: str  # "s", "1" or "bit/s"
    asked: float  # mean on links of the requested profile
    measured: float
    low: float  # lowest value that is believed
    high: float  # highest value that is believed
    verdict: str  # "ok", "off", "open" or "told"


class Expected(NamedTuple):
    """Values that links of the requested profile measure."""

    bands: dict[str, tuple[float, float, float]]  # mean; a share TAIL is below, TAIL above the rest
    pooled: Floats  # delays minus the requested delays, with median 0, sorted [s]
    known: bool  # True if the link's random numbers are known: then a band has no width

    def hidden(self, name: str) -> float:
        """Return half the width of the band of a quantity, in tolerances [1]."""
        mean, low, high = self.bands[name]
        return 0.5 * (high - low) / tolerance(name, mean)

    def judge(self, name: str, value: float) -> Row:
        """Judge one value [unit of the quantity]."""
        mean, low, high = self.bands[name]
        slack, hidden = tolerance(name, mean), self.hidden(name)
        if self.known and name == "deviation":
            slack = max(TOLERANCES[name][0], 0.5 * slack)
        low, high = max(0.0, low - slack), high + slack
        verdict = "ok" if low <= value <= high else "off"
        if isnan(value) or (verdict == "ok" and hidden > CHANCE_MAX):
            verdict = "open"
        return Row(name, UNITS.get(name, "1"), mean, value, low, high, verdict)


@dataclass(frozen=True)
class Plan:
    """Datagrams that measure one direction, and the profile that this direction should have.

    Attributes:
        profile: Requested conditions.
        flow: The datagrams.
        sent: When each is sent, since the link came up [s], shape (n,).
        train: Datagrams per train, sent back to back; a train follows as many single datagrams. 0
            without trains.
        pause: Called every few hundred microseconds, so that other threads run.
    """

    profile: DirectionProfile
    flow: Flow
    sent: Floats
    train: int = 0
    pause: Callable[[], None] = lambda: None

    def draw(self, sent: Floats, epoch: int = 1, first: int = 0) -> Stream:
        """Simulate the link for datagrams sent at `sent` [s], with counters from `first` on.

        The receiver refuses damaged datagrams, so they count as lost.
        """
        seed, uplink, kind, size = self.flow
        link, whole = LinkDirection(self.profile, seed, uplink), bytes(size)
        delays, copies = np.full(len(sent), np.nan), np.zeros(len(sent), int)
        for place, now_ns in enumerate(np.rint(sent * 1e9).astype(np.int64).tolist()):
            fate = link.send(epoch, kind, first + place, size, now_ns)
            if link.corrupts and link.corrupted(epoch, kind, first + place, whole) != whole:
                fate = ()
            if fate:
                delays[place], copies[place] = (min(fate) - now_ns) * 1e-9, len(fate)
            if place % 128 == 0:
                self.pause()
        return Stream(sent, delays, copies)

    @cached_property
    def links(self) -> list[Stream]:
        """Streams of up to RUN_LENGTH datagrams over 200 links as netem shapes them."""
        few = RUN_LENGTH - RUN_LENGTH % max(1, 2 * self.train)
        sent = self.sent[:few] if Timeline(self.profile).only() else self.sent
        seeds = range(-RUNS, 0)  # the seed of an experiment is not negative
        made = replace(self, profile=netem_makes(self.profile))
        return [replace(made, flow=self.flow._replace(seed=seed)).draw(sent) for seed in seeds]

    @cached_property
    def chance(self) -> Expected:
        """Values that `links` measure."""
        return self._expect(self.links)

    def expected(self, measured: Stream, epoch: int = 1, first: int = 0) -> Expected:
        """Return the values that an honest link measures with the datagrams of a stream.

        The values are exact if the stream fits the random numbers of a relay. Otherwise they are
        the band of links with other seeds.
        """
        drawn = self.draw(measured.sent, epoch, first)
        if self._fits(self._singles(measured), self._singles(drawn)):
            return self._expect([drawn])
        factor = sqrt(len(self.links[0].sent) / max(1, len(measured.sent)))
        bands = {
            name: (mean, mean - factor * (mean - low), mean + factor * (high - mean))
            for name, (mean, low, high) in self.chance.bands.items()
        }
        return self.chance._replace(bands=bands)

    def judge(self, measured: Stream, epoch: int = 1, first: int = 0) -> list[Row]:
        """Judge a stream; rows "told" name requested properties that the stream cannot show."""
        expected = self.expected(measured, epoch, first)
        found = self.quantities(measured, expected.pooled)
        rows = [expected.judge(name, found[name]) for name in found if name in expected.bands]
        if len(measured.sent) < FEWEST:
            rows = [row._replace(verdict="open") for row in rows]
        if not expected.known and self.profile.jitter and self.profile.correlation:
            rows.append(told("correlation", self.profile.correlation))
        if not self.train and self.profile.rate:
            rows.append(told("rate", self.profile.rate))
        return rows

    def needed(self) -> int:
        """Return the number of datagrams from which on no band is wider than its tolerances."""
        most = max(map(self.chance.hidden, self.chance.bands))
        return round(len(self.links[0].sent) * max(1.0, most**2))

    def quantities(self, stream: Stream, pooled: Floats) -> dict[str, float]:
        """Compute the judged quantities of a stream; an unknown one is NaN.

        The deviation [s] is that from the delay requested at each time, so it shows the jitter
        alone. The "distribution" is the distance of Kolmogorov and Smirnov from `pooled` [1].
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
        if len(shape) and len(pooled) and pooled.std() > SHAPE_FLOOR:
            points, steps = np.sort(shape), np.arange(len(shape) + 1) / len(shape)
            left, right = (np.searchsorted(pooled, points, side) for side in ("left", "right"))
            far = steps[1:] - left / len(pooled), right / len(pooled) - steps[:-1]
            measured["distribution"] = float(np.max(far))
        return measured

    def _fits(self, measured: Stream, drawn: Stream) -> bool:
        """Return whether the predicted delays, or else the predicted losses, were measured."""
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
        """Return the delays minus the delays requested at their time, with median 0 [s]."""
        delays = stream.delays - _requested_delay(self.profile, stream.sent)
        there: Floats = delays[np.isfinite(delays)]
        return there - np.median(there) if len(there) else there

    def _rate(self, stream: Stream) -> float:
        """Compute the rate at which trains leave a bottleneck [bit/s].

        Source: M. Jain, C. Dovrolis, IEEE/ACM Trans. Networking 12, 2004: packet dispersion.
        """
        arrival = (stream.sent + stream.delays).reshape(-1, 2 * self.train)[:, self.train :]
        arrival = arrival[np.isfinite(arrival).sum(axis=1) > self.train // 2]
        spans = np.nanmax(arrival, axis=1, initial=0.0) - np.nanmin(arrival, axis=1, initial=np.inf)
        bits = (self.train - 1) * (self.flow.size + HEADER_BYTES) * 8.0
        return float(bits / spans.mean()) if len(spans) and spans.mean() > 0.0 else np.nan


def _requested_delay(profile: DirectionProfile, sent: Floats) -> Floats:
    """Return the delay that a profile requests at each time since the link came up [s]."""
    timeline = Timeline(profile)
    if len(timeline.pieces) == 1:
        return np.full(len(sent), timeline.pieces[0].delay_ns * 1e-9)
    times = np.rint(sent * 1e9).astype(np.int64).tolist()
    return np.array([timeline.at(elapsed_ns).delay_ns for elapsed_ns in times]) * 1e-9


def netem_makes(profile: DirectionProfile) -> DirectionProfile:
    """Return the profile with which the model does what netem does with `profile`.

    netem realises almost no correlation of delays. If it draws a loss and a duplicate for a packet,
    one packet arrives; a copy can be lost, too. Source: Linux, net/sched/sch_netem.c.
    """
    loss, lost, single = profile.loss, mean_loss(profile.loss), 1.0 - profile.duplicate
    twice = profile.duplicate * (1.0 - lost) ** 2 / max(1e-9, 1.0 - single * lost)
    if isinstance(loss, GilbertElliott):
        loss = replace(loss, loss_bad=single * loss.loss_bad, loss_good=single * loss.loss_good)
    else:
        loss *= single
    return replace(profile, correlation=0.0, loss=loss, duplicate=twice)


def told(name: str, asked: float, measured: float = nan) -> Row:
    """Make a row with `asked` and `measured` values [any unit] of a quantity that is not judged."""
    return Row(name, UNITS.get(name, "1"), asked, measured, nan, nan, "told")


def tolerance(name: str, asked: float) -> float:
    """Return the tolerance of a quantity of which the profile requests `asked` [any unit]."""
    floor, share = TOLERANCES.get(name, SHARE_TOLERANCE)
    return max(floor, share * asked)


def look_twice(first: Sequence[Row], second: Sequence[Row]) -> list[Row]:
    """Combine two measurements of a link: a row is off only if it is off in both."""
    again = {row.name: row for row in second}
    return [again.get(row.name, row) if row.verdict == "off" else row for row in first]


def verdict_of(rows: Iterable[Row]) -> str:
    """Return "off" if a row is off, else "ok" if all judged rows are ok, else "open"."""
    verdicts = {row.verdict for row in rows} - {"told"}
    return "off" if "off" in verdicts else "ok" if verdicts == {"ok"} else "open"
