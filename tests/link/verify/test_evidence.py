"""What shapers and kernels tell of themselves, read back: qdiscs, metrics, lateness all along."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.cli.link_verify_run import LatenessWatch
from cloudrc.link.profile import DirectionProfile, GilbertElliott
from cloudrc.link.verify.causes import (
    Evidence,
    in_force,
    netem_profile,
    of_metrics,
    of_qdiscs,
    samples,
)

NETEM: dict[str, Any] = {
    "kind": "netem", "handle": "7401:", "packets": 990, "drops": 10,
    "options": {
        "limit": 10000, "delay": {"delay": 0.045, "jitter": 0.025}, "loss-random": {"loss": 0.05},
        "duplicate": {"duplicate": 0.01}, "corrupt": {"corrupt": 0.02},
    },
}  # fmt: skip
PRIO: dict[str, Any] = {"kind": "prio", "handle": "7400:", "packets": 5000, "drops": 0}
ROOM: dict[str, Any] = {"kind": "noqueue", "packets": 0}


def test_netem_on_the_outgoing_interface_is_the_shaper() -> None:
    found = of_qdiscs({"eth0": [PRIO, NETEM], "lo": [ROOM]}, "eth0")
    assert (found.shaper, found.interface, found.layers) == ("netem", "eth0", 1)
    assert found.passed == 1000, "sent on and dropped"
    assert found.elsewhere == ()


def test_none_is_none_even_if_there_is_a_queue() -> None:
    found = of_qdiscs({"eth0": [PRIO], "lo": [ROOM]}, "eth0")
    assert (found.shaper, found.layers, found.passed, found.elsewhere) == ("none", None, None, ())
    assert of_qdiscs({}, "eth0").shaper == "none"


def test_a_netem_elsewhere_is_named() -> None:
    found = of_qdiscs({"eth0": [ROOM], "eth1": [NETEM], "lo": [NETEM]}, "eth0")
    assert (found.shaper, found.elsewhere) == ("none", ("eth1", "lo"))


def test_two_in_a_row_are_two_layers() -> None:
    assert of_qdiscs({"eth0": [NETEM, {**NETEM, "packets": 3}]}, "eth0").layers == 2


def test_what_the_kernel_says_stands_in_place_of_what_was_told() -> None:
    told = Evidence("netem", why="asked", applied=DirectionProfile(0.09), sent=7, restored=1)
    listed = {"eth0": [PRIO, NETEM]}
    found = in_force(of_qdiscs(listed, "eth0"), listed, told)
    assert found.applied == DirectionProfile(0.045, 0.025, loss=0.05, duplicate=0.01, corrupt=0.02)
    assert (found.why, found.sent, found.restored) == ("asked", 7, 1)
    bare = in_force(of_qdiscs({"eth0": [ROOM]}, "eth0"), {"eth0": [ROOM]}, told)
    assert bare.applied is None, "nothing is in force"


def test_bursts_and_rates_are_read_from_tc() -> None:
    options = {
        "loss-gemodel": {"p": 0.01, "r": 0.2, "1-h": 0.9, "1-k": 0.001},
        "rate": {"rate": 250_000},
    }
    found = netem_profile(options, DirectionProfile(0.3))
    assert found.loss == GilbertElliott(0.01, 0.2, 0.9, 0.001)
    assert (found.rate, found.keep_order) == (2e6, True)
    assert netem_profile({"rate": {"rate": 12.5e9}}, DirectionProfile()).rate is None, "for order"


def test_jitter_of_a_table_is_reported_without_its_scale() -> None:
    told = DirectionProfile(0.04, 0.01, distribution="table", table=(-1.0, 0.0, 5.0))
    options = {"delay": {"delay": 0.04, "jitter": 0.02}}
    assert netem_profile(options, told).jitter == pytest.approx(0.01)


def test_metrics_report_lateness_and_restored_qdiscs() -> None:
    text = (
        'cloudrc_link_release_error_seconds{percentile="99"} 0.0021\n'
        "cloudrc_link_restored_total 2\n"
        'cloudrc_link_datagrams_total{outcome="received"} 500\n'
    )
    found = of_metrics(samples(text), 600, Evidence("relay"))
    assert (found.late, found.restored, found.passed, found.sent) == (0.0021, 2, 500, 600)


def test_counts_from_before_the_probes_are_subtracted() -> None:
    before, after = (
        samples(
            f"cloudrc_cpu_periods_total {periods}\n"
            f"cloudrc_cpu_throttled_periods_total {stopped}\n"
            f"cloudrc_link_restored_total {restored}\n"
        )
        for periods, stopped, restored in ((1000, 40, 2), (1100, 45, 3))
    )
    found = of_metrics(after, 0, Evidence("relay"), before)
    assert (found.throttled, found.restored) == (0.05, 1)
    restarted = of_metrics(before, 0, Evidence("relay"), after)
    assert (restarted.throttled, restarted.restored) == (0.04, 2), "it counts from 0 again"


class Relay:
    """Tells one lateness after the other, then the last for ever."""

    def __init__(self, *late: float) -> None:
        self.late = list(late)

    def metrics(self) -> str:
        late = self.late.pop(0) if len(self.late) > 1 else self.late[0]
        return f'cloudrc_link_release_error_seconds{{percentile="99"}} {late}\n'


def test_the_worst_of_all_the_time_is_kept_not_the_last() -> None:
    watch = LatenessWatch({"uplink": Relay(0.0001, 0.0300, 0.0001), "downlink": Relay(0.0002)})
    for _ in range(4):
        watch.look()
    told = Evidence("relay", late=0.0001)
    assert watch.worst("uplink", told).late == pytest.approx(0.030)
    assert watch.worst("downlink", told).late == pytest.approx(0.0002)
    assert LatenessWatch({}).worst("uplink", Evidence()).late is None
