# SPDX-License-Identifier: Apache-2.0

"""netem with a fake kernel: arguments of tc, set-up, restart, schedule and removal."""

import json
from pathlib import Path

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.config.profile import load_profile
from cloudrc.config.shipped import names
from cloudrc.link.draws import Purpose, shape, stream_key
from cloudrc.link.netem import STRETCH, Netem, check, explain, limit, options, table, write_table
from cloudrc.link.profile import LinkSchedule, Trace
from cloudrc.link.traces import link_profile
from tests.link.profiles import blackout, change, in_bursts, profile_of

PEER = ("10.244.0.7", 7400)


class Kernel:
    """An interface with its qdiscs and filters.

    `history` has a row per change of netem: time [ms], new delay with its unit, new loss.
    """

    def __init__(self):
        self.refuses, self.now_ns, self.said = "nothing", 0, []
        self.clear()

    def clock(self):
        return self.now_ns

    def wait(self, duration):
        self.now_ns += round(duration * 1e9)

    def run(self, words):
        line = " ".join(words)
        if not line.startswith(("tc -s -j", "ip")):
            self.said.append(line.removeprefix("tc ").replace("dev eth0 ", ""))
        match words:
            case ["ip", *_]:
                return '[{"dst":"10.244.0.7","dev":"eth0","flags":[]}]'
            case ["tc", "-s", "-j", "qdisc", *_]:
                return json.dumps(self.qdiscs())
            case ["tc", "-s", "-j", "filter", *_]:
                entries = [{"pref": number, "kind": "u32"} for number in self.filters]
                return json.dumps(entries * 2)
            case ["tc", "qdisc", "del", *_]:
                self.clear()
            case ["tc", "qdisc", verb, *rest]:
                if self.refuses in rest:
                    raise explain(words, "Illegal delay")
                if "netem" in rest:
                    assert (verb == "add") is (self.netem is None)
                    self.netem = list(rest[rest.index("netem") + 1 :])
                else:
                    self.root = {"kind": "prio", "handle": "7400:", "root": True}
            case ["tc", "filter", "add", "dev", _, "parent", _, "pref", number, *rest]:
                assert int(number) not in self.filters
                self.filters[int(number)] = " ".join(rest)
            case ["tc", "filter", "del", *_, number]:
                del self.filters[int(number)]
        return ""

    def qdiscs(self):
        leaf = {"kind": "netem", "handle": "7401:", "packets": 90, "drops": 10}
        leaf |= {"qlen": 4, "options": {"words": self.netem}}
        return [self.root, *([leaf] if self.netem is not None else [])]

    def clear(self):
        self.root = {"kind": "noqueue", "handle": "0:", "root": True}
        self.netem = None
        self.filters = {}


def netem(kernel, profile):
    ways = {"clock": kernel.clock, "wait": kernel.wait, "tables": Path("none"), "log": print}
    return Netem(kernel.run, profile, origin_ns=0, **ways)


def shaped(profile, until=0.0):
    """Return a kernel and its `Netem`, after `until` [s] with a profile."""
    kernel = Kernel()
    shaper = netem(kernel, profile)
    assert shaper.follow_peer(PEER) == PEER
    while kernel.now_ns < until * 1e9:
        shaper.step(0.1)
    return kernel, shaper


PLAIN = profile_of(0.04)
EVERYTHING = profile_of(
    0.045, 0.0255, "normal", 0.25, loss=0.015, duplicate=0.02, reorder=0.1, corrupt=0.005
)
TIMED = profile_of(
    0.02,
    duplicate=0.1,
    changes=(change(1.0, delay=0.1, loss=0.5),),
    blackouts=(blackout(2.0, 0.3),),
)
BURSTS = in_bursts(0.1, 0.5, delay_bad=0.04)
SLOW = profile_of(0.3, rate=2e6, queue_packets=100)


def text(profile, at):
    check(profile)
    return " ".join(options(profile, LinkSchedule(profile).at(round(at * 1e9)), limit(profile)))


@pytest.mark.parametrize(
    ("profile", "at", "words"),
    [
        (
            EVERYTHING,
            0.0,
            "limit 10000 delay 45000.000us 25500.000us 25% distribution normal loss random 1.5% "
            "duplicate 2% corrupt 0.5% reorder 10% rate 0bit",
        ),
        (profile_of(loss=in_bursts(0.01, 0.1, 0.6, 0.005)), 0.0, "gemodel 1% 10% 60% 0"),
        (SLOW, 0.0, "limit 747 "),  # 100 + 0.3 s * 2 Mbit/s / (8 * 116 bit)
        (SLOW, 0.0, "rate 2000000bit -14"),
        (profile_of(0.04, 0.03, reorder=0.2, keep_order=True), 0.0, "% rate 100gbit"),
        (profile_of(reorder=0.2), 0.0, "corrupt 0% rate"),  # without a delay tc refuses it
        (TIMED, 1.0, "delay 100000.000us loss random 50% duplicate 10%"),
        (TIMED, 2.1, "delay 100000.000us loss random 100% duplicate 0%"),  # no copy arrives
    ],
)
def test_a_profile_becomes_arguments_of_tc(profile, at, words):
    assert words in text(profile, at)


@pytest.mark.parametrize(
    ("profile", "key"),
    [
        (profile_of(rows=Trace((0.0, 9.0), (0.1, 300.0))), "delay_ms above 274000"),
        (profile_of(changes=(change(1.0, loss=BURSTS),)), "loss.delay_bad_ms"),
    ],
)
def test_a_profile_beyond_netem_is_refused_by_key(profile, key):
    with pytest.raises(BadInputError, match=r"netem cannot do .*; use the relay") as refused:
        check(profile)
    assert key in str(refused.value)


def test_lossy_and_the_radios_of_the_shipped_profiles_need_the_relay():
    profiles = {name: link_profile(load_profile(name).downlink) for name in names("profile")}
    with pytest.raises(BadInputError, match="delay_bad_ms"):
        check(profiles.pop("lossy"))
    for name in ("5g-sa", "5g-sa-configured"):
        with pytest.raises(BadInputError, match="netem cannot do radio"):
            check(profiles.pop(name))
    assert all(text(each, 0.0) for each in profiles.values())


@pytest.mark.parametrize("distribution", sorted(STRETCH))
def test_tables_are_the_models_distributions(distribution, tmp_path):
    profile = profile_of(jitter=1.0, distribution=distribution)
    write_table(tmp_path, profile)
    _, *rows = (tmp_path / f"{distribution}.dist").read_text().splitlines()
    entries = np.array(table(profile))
    assert [int(word) for row in rows for word in row.split()] == entries.tolist()
    assert np.abs(entries).max() < 2**15
    key = stream_key(1, True, 1, 3)
    drawn = np.concatenate([shape(key, Purpose.DELAY, block, profile) for block in range(80)])
    found, shares = entries * STRETCH[distribution] / 8192, np.linspace(0.02, 0.9, 25)
    assert found.mean() == pytest.approx(0.0, abs=0.001)
    assert found.std() == pytest.approx(3**-0.5 if distribution == "uniform" else 1.0, rel=1e-3)
    assert np.quantile(found, shares) == pytest.approx(np.quantile(drawn, shares), abs=0.06)


def test_only_tunnel_datagrams_go_to_netem_and_close_removes_all():
    kernel, shaper = shaped(PLAIN, until=0.1)
    assert {"forwarded": 90, "lost": 10, "restored": 0}.items() <= shaper.counts().items()
    for _ in range(2):
        shaper.close()
    assert kernel.said == [
        "qdisc add root handle 7400: prio bands 4 priomap 1 2 2 2 1 2 0 0 1 1 1 1 1 1 1 1",
        "qdisc add parent 7400:4 handle 7401: netem limit 10000 delay 40000.000us loss random 0% "
        "duplicate 0% corrupt 0% rate 0bit",
        "filter add parent 7400: pref 1 protocol ip u32 match ip protocol 17 0xff "
        "match ip dst 10.244.0.7/32 match ip dport 7400 0xffff flowid 7400:4",
        "qdisc del root",
    ]


def test_qdiscs_of_a_killed_process_are_taken_over():
    kernel, _ = shaped(PLAIN)
    kernel.said.clear()
    netem(kernel, profile_of(0.07)).follow_peer(PEER)
    assert [line[:12] for line in kernel.said] == ["qdisc change", "filter add p", "filter del p"]
    assert len(kernel.filters) == 1


@pytest.mark.parametrize("delay", [300.0, 0.1])
def test_a_refused_profile_leaves_the_old_one_in_force(delay):
    """`check` refuses a delay of 300 s, and tc a delay of 0.1 s."""
    kernel, shaper = shaped(PLAIN)
    before, kernel.refuses = kernel.netem, "100000.000us"
    with pytest.raises((BadInputError, MissingPrerequisiteError), match="delay"):
        shaper.follow_profile(profile_of(delay))
    shaper.step(0.1)
    assert kernel.netem == before
