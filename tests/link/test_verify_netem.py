"""netem verified as between two pods: a true link, and the faults that only a kernel can have."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Mapping
from typing import Any

import pytest

from cloudrc.cli import link_processes
from cloudrc.cli import link_verify_run as run
from cloudrc.cli.link_processes import Shaping, shaping
from cloudrc.cli.link_verify import find
from cloudrc.cli.link_verify_netem import DEVICE
from cloudrc.cli.link_verify_run import Asked, Bank, banks
from cloudrc.cli.link_verify_text import Said, as_text
from cloudrc.config.load import dump
from cloudrc.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.link.verify_causes import find_causes

pytestmark = pytest.mark.netem
SETTINGS = [
    f"link.{way}.{key}"
    for way in ("uplink", "downlink")
    for key in ("delay_ms=400", "jitter_ms=80")  # far above what an emulated machine adds
]
PROFILE = "uplink: &both {delay_ms: 400, jitter_ms: 80}\ndownlink: *both\n"
SECONDS = 17.0
"""At 100 probes a second, which a slow machine can send [s]."""


class Link:
    """A link that is up, and is probed as often as wanted."""

    def __init__(
        self, asked: Mapping[str, Asked], ends: Mapping[str, Bank], ways: Mapping[str, Shaping]
    ) -> None:
        self.asked, self.ends, self.ways = asked, ends, ways

    def verify(self) -> Said:
        findings = run.probe(self.asked, self.ends, self.ways, lambda line: None)
        said = Said(
            "netem", "netem", findings, dict.fromkeys(findings, ""), [], find_causes(findings)
        )
        print(as_text(said))
        return said

    def tc(self, way: str, *words: str) -> None:
        """Meddle with the kernel behind the back of the link's process."""
        command = [*self.ways[way].place.inside, "tc", *words]
        subprocess.run(command, check=True, capture_output=True)


@pytest.fixture(scope="module")
def plan() -> dict[str, Asked]:
    return run.plan(find("ideal", SETTINGS), SECONDS)


@pytest.fixture
def link(plan: dict[str, Asked], monkeypatch: pytest.MonkeyPatch) -> Iterator[Link]:
    monkeypatch.setattr(link_processes, "START_LIMIT", 300.0)  # emulated processors are slow
    try:
        with banks("netem") as ends:
            places = {way: bank.place for way, bank in ends.items()}
            with shaping(places, dump(find("ideal", SETTINGS)), PROFILE, "netem") as ways:
                yield Link(plan, ends, ways)
    except MissingPrerequisiteError as error:
        pytest.exit(f"netem cannot be tested here: {error}", CloudrcError.exit_code + 2)


def codes(said: Said) -> set[str]:
    return {cause.code for cause in said.causes}


def change(link: Link, *words: str) -> None:
    for way in link.ways:
        where = ("dev", DEVICE, "parent", "7400:4", "handle", "7401:")
        link.tc(way, "qdisc", "change", *where, "netem", "limit", "10000", *words)


def test_a_true_link_is_believed_and_faults_are_named(link: Link) -> None:
    # A true link is believed, unless an emulated processor has let it wait: three tries.
    said = next(
        said for tries in range(3) if (said := link.verify()).verdict == "believed" or tries == 2
    )
    assert said.verdict == "believed"
    for found in said.findings.values():
        evidence: Any = found.evidence
        assert (evidence.shaper, evidence.interface, evidence.layers) == ("netem", DEVICE, 1)
        assert evidence.applied.delay == pytest.approx(0.400, abs=1e-4), "read back from tc"

    change(link, "delay", "800ms", "80ms", "distribution", "uniform")
    doubled = link.verify()
    assert codes(doubled) == {"doubled_delay"}
    assert doubled.findings["uplink"].evidence.applied is not None
    assert doubled.findings["uplink"].evidence.applied.delay == pytest.approx(0.800, abs=1e-4)

    link.tc("downlink", "qdisc", "del", "dev", DEVICE, "root")
    change_back = ("delay", "400ms", "80ms", "distribution", "uniform")
    where = ("dev", DEVICE, "parent", "7400:4", "handle", "7401:")
    link.tc("uplink", "qdisc", "change", *where, "netem", "limit", "10000", *change_back)
    assert [(c.code, c.way) for c in link.verify().causes] == [("one_direction", "downlink")]

    link.tc("uplink", "qdisc", "del", "dev", DEVICE, "root")
    assert codes(link.verify()) == {"no_qdisc"}

    for way in link.ways:
        link.tc(way, "qdisc", "add", "dev", "lo", "root", "netem", "delay", "400ms")
    assert codes(link.verify()) == {"wrong_interface"}
