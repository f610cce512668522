"""What a link tells whoever judges it: the profile in force, the kernel's netems, each named."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli.link_run import EMPTY_STATUS, LinkStatusSource
from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott
from cloudrc.link.sidecar import Near, Told, look_near, read_told, write_told
from cloudrc.link.tc import Answer
from cloudrc.link.verify.causes import Evidence, Findings, find_causes, of_told
from cloudrc.link.verify.judge import Row
from cloudrc.link.verify.standing import shown
from tests.link.conftest import PEER, Bench, listing

RICH = DirectionProfile(
    0.04, 0.01, "table", loss=GilbertElliott(0.01, 0.2), duplicate=0.02, rate=2e6, table=(-1.0, 1.0)
)
OURS: dict[str, Any] = {"kind": "netem", "handle": "7401:", "dev": "eth0", "options": {}}
THEIRS: dict[str, Any] = {"kind": "netem", "handle": "8001:", "dev": "eth0", "options": {}}


class Tools:
    """tc and ip of a namespace: what lies there, and over which interface flows leave."""

    def __init__(self, device: str, *qdiscs: dict[str, Any], code: int = 0) -> None:
        self.device, self.qdiscs, self.code = device, qdiscs, code

    def run(self, words: Sequence[str]) -> Answer:
        told = [{"dev": self.device}] if words[0] == "ip" else list(self.qdiscs)
        return Answer(self.code, json.dumps(told), "")


def causes(told: Told, measured: float = 0.0) -> list[str]:
    """Codes for a direction whose mean is off."""
    row = Row("mean", "s", 0.045, 0.045, measured, 0.043, 0.047, "off")
    return [one.code for one in find_causes({"uplink": Findings([row], of_told(told))})]


def test_what_is_told_is_read_as_it_was() -> None:
    told = Told("netem", "link.mode=auto", RICH, Near("eth0", {"eth0": [OURS]}))
    assert read_told(write_told(told)) == told
    bare = Told("relay", "link.mode=relay", None)
    assert read_told(write_told(bare)) == bare


@pytest.mark.parametrize("text", ["{}", "no JSON", '{"shaper": "relay", "why": "", "applied": 3}'])
def test_what_is_something_else_is_a_value_error(text: str) -> None:
    with pytest.raises(ValueError, match="Told"):
        read_told(text)


def test_all_netems_of_a_namespace_are_found_and_nothing_else() -> None:
    room = {"kind": "noqueue", "dev": "lo"}
    tools = Tools("eth1", room, OURS, THEIRS, {**THEIRS, "dev": "eth1"})
    near = look_near(tools.run, PEER[0])
    assert near == Near("eth1", {"eth0": [OURS, THEIRS], "eth1": [{**THEIRS, "dev": "eth1"}]})


def test_where_there_are_no_tools_nothing_is_claimed() -> None:
    assert look_near(Tools("eth0", code=127).run, PEER[0]) is None
    assert of_told(Told("netem", "", RICH)) == Evidence("netem", layers=1, applied=RICH)


@pytest.mark.parametrize(
    ("shaper", "leaves", "netems", "code"),
    [
        ("netem", "eth1", {"eth0": [OURS]}, "wrong_interface"),
        ("netem", "eth0", {}, "no_qdisc"),
        ("netem", "eth0", {"eth0": [OURS, THEIRS]}, "shaped_twice"),
        ("relay", "eth0", {"eth0": [THEIRS]}, "shaped_twice"),
        ("relay", "eth0", {"lo": [THEIRS]}, "shaped_twice"),
    ],
)
def test_what_lies_on_the_way_of_the_flow_is_the_cause(
    shaper: str, leaves: str, netems: dict[str, list[dict[str, Any]]], code: str
) -> None:
    told = Told(shaper, "link.mode=auto", DirectionProfile(0.045), Near(leaves, netems))
    assert causes(told, 0.09) == [code]


def test_what_lies_aside_of_it_is_none() -> None:
    applied = DirectionProfile(0.045)
    for told in (
        Told("relay", "", applied, Near("eth0", {"eth1": [THEIRS]})),
        Told("netem", "", applied, Near("eth0", {"eth0": [OURS], "lo": [THEIRS]})),
    ):
        assert causes(told, 0.09) == ["doubled_delay"]


def test_of_netem_the_kernel_says_what_is_applied() -> None:
    options = listing("limit 10 delay 90000us duplicate 3%".split())
    near = Near("eth0", {"eth0": [{**OURS, "options": options}]})
    assert of_told(Told("netem", "", RICH, near)).applied == DirectionProfile(
        0.09, 0.0, "table", duplicate=0.03, table=RICH.table
    )


def test_what_is_applied_has_a_number_for_every_row() -> None:
    profile = DirectionProfile(0.04, 0.01, "normal", loss=0.1, duplicate=0.02, corrupt=0.5)
    found = shown(profile, 200, "relay")
    assert found["mean"] == pytest.approx(0.04, rel=0.01)
    assert found["deviation"] == pytest.approx(0.01, rel=0.01)
    assert found["loss"] == pytest.approx(0.55), "what is damaged is refused"
    assert found["duplicated"] == 0.02
    assert found["reordered"] > 0.1
    assert found["middle"] > 0.0
    assert shown(DirectionProfile(0.04, keep_order=True), 200, "relay")["reordered"] == 0.0
    doubled = shown(DirectionProfile(0.04, loss=0.2, duplicate=0.3), 200, "netem")
    assert doubled["loss"] == pytest.approx(0.14), "of what is doubled and lost one copy arrives"
    assert doubled["duplicated"] == pytest.approx(0.22, abs=0.005)


def tells(bench: Bench, *at: float) -> list[Told | None]:
    """What a sidecar tells at such times [s]."""
    found: list[Told | None] = []
    for one in at:
        bench.at(one, lambda: found.append(bench.sidecar.told()))
    bench.run(max(at) + 0.5)
    return found


def test_a_sidecar_tells_what_is_in_force_and_nothing_before(tmp_path: Path) -> None:
    bench = Bench(tmp_path, "relay", profile=RICH)
    assert bench.sidecar.told() is None
    bench.at(1.0, lambda: bench.replace(0.07))
    first, later = tells(bench, 0.5, 1.5)
    assert first == Told("relay", "link.mode=relay", RICH)
    assert later == Told("relay", "link.mode=relay", DirectionProfile(0.07))


def test_while_a_time_line_runs_nothing_is_said_to_be_applied(tmp_path: Path) -> None:
    changes = (Change(1.0, delay=0.08, jitter=0.01),)
    profile = DirectionProfile(0.04, changes=changes, blackouts=(Blackout(0.2, 0.1),))
    running, over = tells(Bench(tmp_path, "relay", profile=profile), 0.5, 1.5)
    assert running is not None
    assert running.applied is None
    assert over is not None
    assert over.applied == DirectionProfile(0.08, 0.01)


def test_tools_are_started_at_most_once_a_second(tmp_path: Path) -> None:
    bench, asked, now = Bench(tmp_path, "relay"), list[str](), [0.0]

    def look(host: str) -> Near:
        asked.append(host)
        return Near("eth0", {})

    teller = LinkStatusSource(bench.sidecar, look, lambda: now[0])
    assert teller.text() == EMPTY_STATUS
    bench.run(0.5)
    for now[0] in (1.0, 1.5, 1.9, 2.1):
        assert read_told(teller.text()).near == Near("eth0", {})
    assert asked == [PEER[0]] * 2
