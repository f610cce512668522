"""What shapers and kernels report of themselves, read back: state, metrics, qdiscs."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Near, Told
from cloudrc.link.verify.causes import Evidence, Findings, find_causes, read_evidence, read_metrics
from cloudrc.link.verify.judge import Row

NETEM: dict[str, Any] = {"kind": "netem", "handle": "7401:", "options": {}}
APPLIED = DirectionProfile(0.045)


def cause(told: Told) -> list[str]:
    """Return the codes for a direction whose mean delay is doubled."""
    row = Row("mean", "s", 0.045, 0.045, 0.09, 0.043, 0.047, "off")
    return [one.code for one in find_causes({"uplink": Findings([row], read_evidence(told, {}))})]


@pytest.mark.parametrize(
    ("shaper", "leaves", "netems", "code"),
    [
        ("netem", "eth1", {"eth0": [NETEM]}, "wrong_interface"),
        ("netem", "eth0", {}, "no_qdisc"),
        ("netem", "eth0", {"eth0": [NETEM, NETEM]}, "shaped_twice"),
        ("relay", "eth0", {"eth0": [NETEM]}, "shaped_twice"),
        ("relay", "eth0", {"lo": [NETEM]}, "shaped_twice"),
        ("relay", "eth0", {"eth1": [NETEM]}, "doubled_delay"),
        ("netem", "eth0", {"eth0": [NETEM], "lo": [NETEM]}, "doubled_delay"),
    ],
)
def test_qdiscs_on_the_way_of_the_flow_are_the_cause(
    shaper: str, leaves: str, netems: dict[str, list[dict[str, Any]]], code: str
) -> None:
    assert cause(Told(shaper, "", APPLIED, Near(leaves, netems))) == [code]


def test_without_tools_nothing_is_claimed() -> None:
    told = Told("relay", "link.mode=relay", APPLIED)
    assert read_evidence(told, {}, 5) == Evidence(
        "relay", "link.mode=relay", layers=1, applied=APPLIED, sent=5
    )


def metrics(periods: int, stopped: int, restored: int) -> dict[str, float]:
    text = (
        'cloudrc_link_release_error_seconds{percentile="99"} 0.0021\n'
        'cloudrc_link_datagrams_total{outcome="received"} 500\n'
        'cloudrc_link_datagrams_total{outcome="unread"} 3\n'
        f"cloudrc_cpu_periods_total {periods}\n"
        f"cloudrc_cpu_throttled_periods_total {stopped}\n"
        f"cloudrc_link_restored_total {restored}\n"
    )
    return dict(read_metrics(text))


def test_metrics_report_lateness_counts_and_stops() -> None:
    told = Told("relay", "", None)
    found = read_evidence(told, metrics(100, 40, 2), 600)
    assert (found.late, found.restored, found.passed, found.unread) == (0.0021, 2, 500, 3)
    assert (found.throttled, found.sent) == (0.4, 600)
    assert read_evidence(told, metrics(100, 40, 2)).passed is None, "since its start"


def test_netem_is_counted_by_the_kernel() -> None:
    applied = DirectionProfile(0.045, loss=0.2, duplicate=0.3, correlation=0.5)
    near = Near("eth0", {"eth0": [NETEM | {"packets": 85, "drops": 15}]})
    found = read_evidence(Told("netem", "", applied, near), {}, 100)
    assert found.passed == 100
    assert found.applied is not None
    assert (found.applied.loss, found.applied.correlation) == (pytest.approx(0.14), 0.0)
