# SPDX-License-Identifier: Apache-2.0

"""Results of networked control that are known exactly, beside what cloudrc measures.

    python examples/canon.py            # the table of docs/closed-forms.md: minutes
    python examples/canon.py .1         # with a tenth of the steps

Each function returns the exact value and one measurement per independent run. Plants are those of
`cloudrc/Linear-v0`, losses and queues those of `cloudrc.link`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import cache, partial
from math import ceil, comb, floor, inf, log10, pi, sqrt
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from numpy.typing import NDArray

import cloudrc.link
from cloudrc.gym import Networked
from cloudrc.results.metrics.age import describe, sawtooth

Floats = NDArray[np.float64]
Found = tuple[float, Floats]  # the exact value, and a measurement per run, shape (runs,)
PERIOD = 0.01  # time between two packets [s]
HEAVY = "E[P], loss .45"  # of infinite variance: only a long run is near its mean


class Row(NamedTuple):
    """A result, and how long it is measured."""

    name: str
    measure: Callable[[int, int], Found]  # takes the numbers of runs and of steps
    runs: int
    steps: int

    def at(self, scale: float = 1.0) -> tuple[float, float, float]:
        """Return the exact value, the mean of the runs and its standard error."""
        exact, found = self.measure(self.runs, ceil(self.steps * scale))
        return exact, float(found.mean()), float(found.std(ddof=1)) / sqrt(len(found))


def losses(loss: Any, runs: int, steps: int, way: int = 0) -> NDArray[np.bool_]:
    """Return which packets are lost, shape (steps, runs); `way` 0 is the uplink, 1 the downlink."""
    both = {"uplink": {"loss": loss}, "downlink": {"loss": loss}}
    links = [cloudrc.link.open(both, seed)[way] for seed in range(runs)]
    return np.array([np.isnan(each.table(steps, PERIOD)) for each in links]).T


# A scalar plant whose state is measured, over a lossy link. B. Sinopoli et al., "Kalman Filtering
# with Intermittent Observations", IEEE TAC 49(9), 2004.


def kalman(a: float, p: float, runs: int, steps: int) -> Found:
    """Mean variance of the error before an observation that is lost with the chance p."""
    variance, total = np.ones(runs), np.zeros(runs)
    for lost in losses(p, runs, steps):
        total += variance
        variance = a * a * variance * lost + 1.0
    return 1.0 / (1.0 - a * a * p), total / steps


def kalman_networked(a: float, p: float, runs: int, steps: int) -> Found:
    """Mean square of the state behind `Networked`, with input -a y, and 0 without observation."""
    found = np.zeros(runs)
    for seed in range(runs):
        plant = gymnasium.make("cloudrc/Linear-v0", A=a)
        env = Networked(plant, {"uplink": {"loss": p}}, seed=seed, hold="start")
        seen, _ = env.reset(seed=seed)
        for _ in range(steps):
            seen, reward, *_ = env.step(-a * seen)
            found[seed] -= float(reward) / steps
    return 1.0 / (1.0 - a * a * p), found


def kalman_variance(a: float, p: float, runs: int, steps: int) -> Found:
    """Variance of P, the variance of the error before an observation."""
    mean, exact = moments_of_p(a, p)
    variance, squares = np.ones(runs), np.zeros(runs)
    for lost in losses(p, runs, steps):
        squares += (variance - mean) ** 2
        variance = a * a * variance * lost + 1.0
    return exact, squares / steps


def moments_of_p(a: float, p: float) -> tuple[float, float]:
    """Return mean and variance of P. The variance is finite only for p < 1 / a^4.

    A loss multiplies P by a^2, and so its square by a^4.
    """
    if a**4 * p >= 1.0:
        return (1.0 / (1.0 - a * a * p) if a * a * p < 1.0 else inf), inf
    mean = 1.0 / (1.0 - a * a * p)
    square = (1.0 + 2.0 * a * a * p * mean) / (1.0 - a**4 * p)
    return mean, square - mean**2


def tail_index(a: float, loss: Any, runs: int, steps: int) -> Found:
    """Tail index of the squared error (Hill): 1 where its mean begins to be infinite."""
    noise = np.random.default_rng(1).standard_normal((steps, runs))
    errors, error = np.empty((steps, runs)), np.zeros(runs)
    for step, lost in enumerate(losses(loss, runs, steps)):
        error = a * error * lost + noise[step]
        errors[step] = error
    largest = np.sort(errors**2, axis=0)[-steps // 200 :]  # of each run
    return 1.0, 1.0 / np.log(largest[1:] / largest[0]).mean(axis=0)


# LQG over loss both ways, C = 1, V = 0. L. Schenato et al., "Foundations of Control and Estimation
# over Lossy Networks", Proc. IEEE 95(1), 2007. All plants: a = 1.2, b = Q = R = W = 1.
A = 1.2


def many_plants(runs: int) -> gymnasium.Env[Floats, Floats]:
    """Make independent plants, one per state."""
    return gymnasium.make("cloudrc/Linear-v0", A=A, B=np.eye(runs), R=1.0)


def regulated(p: float, acknowledged: bool) -> tuple[float, float]:
    """Return gain and cost per step of the best controller behind loss p both ways.

    It hears which commands arrived (as TCP), or not (as UDP).
    """
    share = 1.0 - p
    known, unknown = 1.0, 1.0  # prices of a state that the controller knows, and does not know
    for _ in range(10_000):
        alpha = 0.0 if acknowledged else (1.0 - share) ** 2
        price = 1.0 + (1.0 - alpha) * known + alpha * unknown
        gain = A * known / price
        known, unknown = (
            1.0 + A * A * known - share * (A * known) ** 2 / price,
            1.0 + share * A * A * known + (1.0 - share) * A * A * unknown,
        )
    return gain, share * known + (1.0 - share) * unknown


def lqg(p: float, acknowledged: bool, runs: int, steps: int) -> Found:
    """Cost per step of this controller."""
    gain, exact = regulated(p, acknowledged)
    env = many_plants(runs)
    x = estimate = env.reset(seed=1)[0]
    cost = np.zeros(runs)
    for no_state, no_input in zip(
        losses(p, runs, steps), losses(p, runs, steps, way=1), strict=True
    ):
        estimate = np.where(no_state, estimate, x)
        sent = -gain * estimate
        applied = np.where(no_input, 0.0, sent)
        cost += x**2 + applied**2
        estimate = A * estimate + (applied if acknowledged else (1.0 - p) * sent)
        x = env.step(applied)[0]
    return exact, cost / steps


def lqg_networked(p: float, acknowledged: bool, runs: int, steps: int) -> Found:
    """Cost per step of this controller behind `Networked`: it answers in every step."""
    gain, exact = regulated(p, acknowledged)
    both, found = {way: {"loss": p} for way in ("uplink", "downlink")}, np.zeros(runs)
    for seed in range(runs):
        plant = gymnasium.make("cloudrc/Linear-v0", A=A, R=1.0, disable_env_checker=True)
        env = Networked(
            plant,
            both,
            seed,
            hold="start",
            answers="step",
            acknowledge="ideal" if acknowledged else None,
        )
        seen, info = env.reset(seed=seed)
        estimate = float(seen[0])
        for step in range(steps):
            sent = -gain * estimate
            seen, reward, _, _, info = env.step(np.array([sent]))
            found[seed] -= float(reward) / steps
            about = info["cloudrc"]
            arrived = step in about["acknowledged"][-1:] if acknowledged else 1.0 - p
            estimate = A * estimate + arrived * sent
            if about["observation_age"] == 0.0:
                estimate = float(seen[0])
    return exact, found


# Packets with the inputs of the next N steps. D. E. Quevedo, D. Nesic, "Input-to-State Stability of
# Packetized Predictive Control over Unreliable Networks", IEEE TAC 56(2), 2011. With one input, the
# plant gets zero after it, or holds it: L. Schenato, "To Zero or to Hold Control Inputs with Lossy
# Links?", IEEE TAC 54(5), 2009.


def regulator() -> tuple[float, float]:
    """Return price and gain of the regulator without a network."""
    price = (A * A + sqrt(A**4 + 4.0)) / 2.0  # of x = 1 + a^2 x / (1 + x), with b = Q = R = 1
    return price, A * price / (1.0 + price)


def packetised(p: float, size: int, hold: bool, runs: int, steps: int) -> Found:
    """Cost per step with `size` inputs in a packet; after the last, the plant gets 0 or holds."""
    _, gain = regulator()
    plan = -gain * (A - gain) ** np.arange(size)  # for a state of 1
    env = many_plants(runs)
    x, _ = env.reset(seed=1)
    basis, age, last, cost = x, np.zeros(runs, int), np.zeros(runs), np.zeros(runs)
    for lost in losses(p, runs, steps, way=1):
        basis, age = np.where(lost, basis, x), np.where(lost, age + 1, 0)
        planned = plan[np.minimum(age, size - 1)] * basis
        last = np.where(age < size, planned, last if hold else 0.0)
        cost += x**2 + last**2
        x = env.step(last)[0]
    return packetised_exact(p, size, hold), cost / steps


def packetised_exact(p: float, size: int, hold: bool) -> float:
    """Return the cost from second moments of (state, state that the plan expects, last input).

    The number of packets lost in a row is a Markov chain; its last phase is an empty buffer.
    """
    _, gain = regulator()
    phases = size + 1
    chances = np.append((1.0 - p) * p ** np.arange(size), p**size)
    inputs = np.zeros((phases, 3))
    inputs[:size, 1] = -gain
    inputs[size, 2] = hold
    steps = np.zeros((phases, 3, 3))
    steps[:, 0, 0], steps[:size, 1, 1] = A, A
    steps[:, 0] += inputs
    steps[:size, 1] += inputs[:size]
    steps[:, 2] = inputs
    arrival = np.array([[1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    moments = np.zeros((phases, 3, 3))
    for _ in range(2_000):
        after = steps @ moments @ steps.transpose(0, 2, 1)
        after[:, 0, 0] += chances
        moments[0] = (1.0 - p) * arrival @ after.sum(axis=0) @ arrival.T
        moments[1:] = p * after[:-1]
        moments[-1] += p * after[-1]
    used = np.einsum("pi,pij,pj->", inputs, moments, inputs)
    return float(moments[:, 0, 0].sum() + used)


# Sending on a threshold, with the executor of send_on_delta.py. K. J. Astrom, B. Bernhardsson,
# "Comparison of Riemann and Lebesgue Sampling for First Order Stochastic Systems", CDC 2002.
ON_DELTA = str(Path(__file__).with_name("send_on_delta.py"))


def send_on_delta(delta: float, runs: int, steps: int) -> Found:
    """Mean square of an integrator with noise, whose state is sent and reset from `delta` on."""
    found, executor = np.zeros(runs), {"name": ON_DELTA, "delta": delta}
    for seed in range(runs):
        plant = gymnasium.make("cloudrc/Linear-v0", A=1.0)
        env = Networked(plant, seed=seed, hold="start", executor=executor)
        seen, _ = env.reset(seed=seed)
        for _ in range(steps):
            seen, reward, *_ = env.step(-seen)
            found[seed] -= float(reward) / steps
    return send_on_delta_exact(delta)[0], found


def send_on_delta_exact(delta: float, nodes: int = 200) -> tuple[float, float]:
    """Return the mean square, and the share of the steps in which the state is sent.

    Between two resets, the density of the state obeys an integral equation of Fredholm; its nodes
    are those of Gauss and Legendre.
    """
    x, weights = np.polynomial.legendre.leggauss(nodes)
    x, weights = delta * x, delta * weights

    def normal(y: Floats) -> Floats:
        return np.exp(-y * y / 2.0) / sqrt(2.0 * pi)

    kernel = normal(x[:, None] - x) * weights
    visits = np.linalg.solve(np.eye(nodes) - kernel, normal(x))  # of a state, between two resets
    share = 1.0 / (1.0 + weights @ visits)
    return float(1.0 + share * (weights @ (x * x * visits))), float(share)


# Age of information: the age of the newest data that has arrived. S. Kaul et al., "Real-Time
# Status: How Often Should One Update?", INFOCOM 2012; peaks: M. Costa et al., "On the Age of
# Information in Status Update Systems with Packet Management", IEEE TIT 62(4), 2016. The reports of
# flights have these numbers from the same functions.
NS = 1e9


def age_of(sent: Floats, arrived: Floats, limit: float | None = None) -> dict[str, float]:
    """Return mean and mean peak [s] of the age, and the share of the time above `limit` [s].

    `sent` and `arrived` [s] belong to packets in the order of arrival.
    """
    sent_ns, arrived_ns = (np.rint(NS * each).astype(int) for each in (sent, arrived))
    return describe(sawtooth(arrived_ns, arrived_ns, sent_ns), limit)


def age_over_loss(part: str, p: float, runs: int, steps: int) -> Found:
    """Age with a packet per 10 ms that takes 200 ms: mean [s], mean peak [s], P(> 220 ms)."""
    delay = 0.2
    exact = {
        "mean": delay + PERIOD * (1.0 + p) / (1.0 - p) / 2.0,
        "peak_mean": delay + PERIOD / (1.0 - p),
        "violation": p**2,
    }
    return exact[part], np.array([each[part] for each in ages_over_loss(delay, p, runs, steps)])


@cache
def ages_over_loss(delay: float, p: float, runs: int, steps: int) -> list[dict[str, float]]:
    """Measure all numbers of the age at once, for each run."""
    found = []
    for seed in range(runs):
        up, _ = cloudrc.link.open({"uplink": {"delay_ms": 1e3 * delay, "loss": p}}, seed)
        delays = up.table(steps, PERIOD)
        sent = np.arange(steps)[~np.isnan(delays)] * PERIOD
        found.append(age_of(sent, sent + delay, delay + 2.0 * PERIOD))
    return found


def age_in_queue(part: str, runs: int, steps: int) -> Found:
    """Age behind a queue M/M/1 with load .5 and a service time of 1 s: mean or mean peak [s]."""
    found = [each[part] for each in ages_in_queue(runs, steps)]
    return {"mean": 3.5, "peak_mean": 4.0}[part], np.array(found)


@cache
def ages_in_queue(runs: int, steps: int) -> list[dict[str, float]]:
    """Measure all numbers of the age at once, for each run."""
    found = []
    for seed in range(runs):
        noise = np.random.default_rng(seed)
        sent = np.cumsum(noise.exponential(2.0, steps))
        served = np.cumsum(noise.exponential(1.0, steps))
        before = np.append(0.0, served[:-1])
        arrived = np.maximum.accumulate(sent - before) + served  # Lindley's recursion
        found.append(age_of(sent, arrived))
    return found


# Asynchronous inference: how long the robot has no action.


def starvation(share: float, delay: int, runs: int, steps: int) -> Found:
    """Share of steps without an action: chunks of 50, asked for when `share` of one is left [1].

    The answer comes `delay` steps late.
    """
    size = 50
    asks_at = floor(share * size)
    exact = max(0.0, delay - asks_at) / (size - 2 * asks_at + delay)
    link = {"downlink": {"delay_ms": 1e3 * delay * PERIOD}}
    plant = gymnasium.make("cloudrc/Linear-v0", A=0.0)
    executor = {"name": "async", "share": share, "aggregate": "latest"}
    env = Networked(plant, link, chunk=size, executor=executor, start="answer")
    env.reset(seed=1)
    found = np.zeros(runs)
    for run in range(runs):
        found[run] = sum(env.step(np.zeros((size, 1)))[4]["cloudrc"]["held"] for _ in range(steps))
    return exact, found / steps


# The link's own parts: its queue, its bursts, its reordering.
SERVICE_S = 0.002  # of a packet of 222 + 28 bytes at 1 Mbit/s


def waits(departures: Floats, seed: int) -> Floats:
    """Return how long packets wait in the bottleneck [s], shape (n,); departures [s] rise."""
    up, _ = cloudrc.link.open({"uplink": {"rate_kbit": 1000, "queue_packets": 1_000_000}}, seed)
    times = np.rint(departures * 1e9).astype(int).tolist()
    arrivals = [up.send(0, number, 222, now)[0] for number, now in enumerate(times)]
    return (np.array(arrivals) - times) * 1e-9 - SERVICE_S


def poisson_queue(load: float, runs: int, steps: int) -> Found:
    """Mean wait behind Poisson packets of one size, M/D/1 [ms] (Pollaczek, Khinchine)."""
    found = []
    for seed in range(runs):
        gaps = np.random.default_rng(seed).exponential(SERVICE_S / load, steps)
        found.append(1e3 * waits(np.cumsum(gaps), seed).mean())
    return 1e3 * SERVICE_S * load / (1.0 - load) / 2.0, np.array(found)


def periodic_queue(senders: int, runs: int, steps: int) -> Found:
    """Mean wait of N senders with a period of 10 ms and random phases, N D/D/1 [ms].

    Source: J. Roberts, U. Mocci, J. Virtamo (eds.), "Broadband Network Teletraffic", 1996.
    """
    slots, others = PERIOD / SERVICE_S, senders - 1  # the period in service times
    wait = np.linspace(0.0, others, 20_001)
    above = np.zeros(len(wait))
    for k in range(1, others + 1):
        share = (k - wait) / slots
        term = comb(others, k) * share**k * (1.0 - share) ** (others - k)
        above += np.where(k > wait, term * (slots - others + wait) / (slots - k + wait), 0.0)
    exact = 1e3 * SERVICE_S * float(np.trapezoid(np.minimum(above, 1.0), wait))
    found = []
    for seed in range(runs):
        noise, rounds = np.random.default_rng(seed), []
        for number in range(steps):  # each time with new phases, in a period of rest
            phases = np.sort(noise.uniform(0.0, PERIOD, senders))
            rounds += [phases + (3 * number + n) * PERIOD for n in (0, 1)]
        found.append(1e3 * waits(np.concatenate(rounds), seed).reshape(-1, 2, senders)[:, 1].mean())
    return exact, np.array(found)


def burst_length(runs: int, steps: int) -> Found:
    """Mean number of packets lost in a row (E. N. Gilbert, E. O. Elliott): 1 / bad_end."""
    lost = losses({"bad_start": 0.02, "bad_end": 0.25}, runs, steps)
    begins = lost[1:] & ~lost[:-1]
    return 4.0, lost.sum(axis=0) / np.maximum(begins.sum(axis=0) + lost[0], 1)


def reordered(runs: int, steps: int) -> Found:
    """Share of packets that a later one overtakes [%] (RFC 4737, 4.1): 2 % do not wait 45 ms."""
    chance, behind = 0.02, 4  # of each packet, and how many leave while one waits
    found = []
    for seed in range(runs):
        up, _ = cloudrc.link.open({"uplink": {"delay_ms": 45, "reorder": chance}}, seed)
        arrived = np.arange(steps) * PERIOD + up.table(steps, PERIOD)
        order = np.argsort(arrived, kind="stable")
        is_late = order < np.maximum.accumulate(order)
        found.append(100.0 * is_late.mean())
    return 100.0 * (1.0 - chance) * (1.0 - (1.0 - chance) ** behind), np.array(found)


def rows() -> list[Row]:
    """Return all results of the table."""
    limit = 1.0 / 1.25**2  # the largest loss with a finite mean
    bursts = {"bad_start": 0.1, "bad_end": 1.0 - limit}
    found = [
        Row("Sinopoli 2004: E[P], loss .1", partial(kalman, 1.25, 0.1), 100, 20_000),
        Row("E[P], loss .3", partial(kalman, 1.25, 0.3), 100, 50_000),
        Row(HEAVY, partial(kalman, 1.25, 0.45), 100, 500_000),
        Row("Var[P], loss .1", partial(kalman_variance, 1.25, 0.1), 100, 50_000),
        Row("E[x²] through `Networked`, loss .1", partial(kalman_networked, 1.25, 0.1), 20, 10_000),
        Row("E[x²] through `Networked`, loss .3", partial(kalman_networked, 1.25, 0.3), 20, 10_000),
        Row("tail index at the limit, loss .64", partial(tail_index, 1.25, limit), 40, 200_000),
        Row("the same with loss in bursts", partial(tail_index, 1.25, bursts), 40, 200_000),
        Row("Schenato 2007: LQG, loss .3, TCP-like", partial(lqg, 0.3, True), 200, 10_000),
        Row("LQG, loss .3, UDP-like", partial(lqg, 0.3, False), 200, 10_000),
        Row("LQG through `Networked`, TCP-like", partial(lqg_networked, 0.3, True), 20, 10_000),
        Row("LQG through `Networked`, UDP-like", partial(lqg_networked, 0.3, False), 20, 10_000),
    ]
    for name, size, hold in (
        ("Quevedo 2011: 1 input in a packet, loss .2", 1, False),
        ("2 inputs in a packet", 2, False),
        ("all inputs in a packet", 40, False),
        ("Schenato 2009: 1 input, held", 1, True),
    ):
        found.append(Row(name, partial(packetised, 0.2, size, hold), 200, 10_000))
    for delta, name in ((1, "Åström 2002: send-on-delta at 1"), (2, "at 2"), (3, "at 3")):
        found.append(Row(name, partial(send_on_delta, delta), 20, 4_000))
    for part, name in (
        ("mean", "Kaul 2012: age, loss .1 [s]"),
        ("peak_mean", "Costa 2016: peak age [s]"),
        ("violation", "P(age > D + 2T)"),
    ):
        found.append(Row(name, partial(age_over_loss, part, 0.1), 20, 100_000))
    for part, name in (
        ("mean", "age behind M/M/1, load .5 [s]"),
        ("peak_mean", "peak age behind M/M/1 [s]"),
    ):
        found.append(Row(name, partial(age_in_queue, part), 20, 500_000))
    for share, delay in ((0.1, 20), (0.5, 30), (0.5, 60)):
        name = f"starvation of `async`, share {share:g}, {delay} steps late"
        found.append(Row(name, partial(starvation, share, delay), 3, 10_000))
    return [
        *found,
        Row(
            "Pollaczek 1930: wait in M/D/1, load .8 [ms]", partial(poisson_queue, 0.8), 20, 100_000
        ),
        Row("Roberts 1996: wait in 4·D/D/1 [ms]", partial(periodic_queue, 4), 20, 10_000),
        Row("Gilbert 1960: length of bursts [packets]", burst_length, 20, 100_000),
        Row("RFC 4737: reordered packets [%]", reordered, 20, 100_000),
    ]


def main(scale: float) -> None:
    """Print the table."""
    print("| result | exact | measured, 95 % | runs x steps |")
    print("|---|---|---|---|")
    for row in rows():
        exact, mean, error = row.at(scale)
        half = 1.96 * error
        digits = max(1 - floor(log10(half)), 0)  # two of the interval
        cells = f"{exact:.{digits}f} | {mean:.{digits}f} ± {half:.{digits}f}"
        print(f"| {row.name} | {cells} | {row.runs} x {ceil(row.steps * scale):,} |", flush=True)


if __name__ == "__main__":
    main(float(sys.argv[1]) if sys.argv[1:] else 1.0)
