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
from tests.link.conftest import PEER, Bench

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
