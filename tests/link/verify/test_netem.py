"""netem verified as between two pods: a true link, and the faults that only a kernel can have."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

from cloudrc.cli import link_processes
from cloudrc.cli import link_verify_run as run
from cloudrc.cli.link_processes import DIRECTIONS, ShaperProcess, run_shapers
from cloudrc.cli.link_verify import find_experiment
from cloudrc.cli.link_verify_run import DEVICE, DirectionPlan, ProbeEndpoint, open_probe_endpoints
from cloudrc.cli.link_verify_text import VerifyReport, as_text
from cloudrc.config.load import dump
from cloudrc.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.link.verify.causes import find_causes

pytestmark = pytest.mark.netem
SETTINGS = [
    f"link.{way}.{key}"
    for way in ("uplink", "downlink")
    for key in ("delay_ms=400", "jitter_ms=80")  # far above what an emulated machine adds
]
PROFILE = "uplink: &both {delay_ms: 400, jitter_ms: 80}\ndownlink: *both\n"
SECONDS = 17.0
"""At 100 probes a second, which a slow machine can send [s]."""
LOSING_SECONDS = 28.0
"""Likewise where 30 % of them are lost [s]."""


class Link:
    """A link that is up, and is probed as often as wanted."""

    def __init__(
        self,
        asked: Mapping[str, DirectionPlan],
        ends: Mapping[str, ProbeEndpoint],
        ways: Mapping[str, ShaperProcess],
    ) -> None:
        self.asked, self.ends, self.ways = asked, ends, ways

    def verify(self) -> VerifyReport:
        findings = run.probe_link(self.asked, self.ends, self.ways, lambda line: None)
        said = VerifyReport(
            "netem", "netem", findings, dict.fromkeys(findings, ""), [], find_causes(findings)
        )
        print(as_text(said))
        return said

    def stop(self) -> None:
        """Let the link's processes stand still, so that they put nothing back."""
        for one in self.ways.values():
            one.process.send_signal(signal.SIGSTOP)

    def tc(self, way: str, *words: str) -> None:
        """Meddle with the kernel behind the back of the link's process."""
        command = [*self.ways[way].place.inside, "tc", *words]
        subprocess.run(command, check=True, capture_output=True)


@pytest.fixture(scope="module")
def plan() -> dict[str, DirectionPlan]:
    return run.plan(find_experiment("ideal", SETTINGS), SECONDS, "netem")


@contextmanager
def up(plan: dict[str, DirectionPlan], profile: str = PROFILE) -> Iterator[Link]:
    """A link whose processes were told `profile`, whatever was asked for."""
    try:
        with open_probe_endpoints("netem") as ends:
            places = {way: bank.place for way, bank in ends.items()}
            with run_shapers(
                places, dump(find_experiment("ideal", SETTINGS)), profile, "netem"
            ) as ways:
                yield Link(plan, ends, ways)
    except MissingPrerequisiteError as error:
        pytest.exit(f"netem cannot be tested here: {error}", CloudrcError.exit_code + 2)


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_processes, "START_LIMIT", 300.0)  # emulated processors are slow


def codes(said: VerifyReport) -> set[str]:
    return {cause.code for cause in said.causes}


def patiently(link: Link) -> VerifyReport:
    """A true link is believed, unless an emulated processor has let it wait: three tries."""
    for _ in range(2):
        if (said := link.verify()).verdict == "believed":
            return said
    return link.verify()


@pytest.mark.smoke
def test_a_true_link_is_believed_but_not_without_its_qdisc(
    plan: dict[str, DirectionPlan],
) -> None:
    with up(plan) as link:
        said = patiently(link)
        assert said.verdict == "believed"
        for found in said.findings.values():
            evidence: Any = found.evidence
            assert (evidence.shaper, evidence.interface, evidence.layers) == ("netem", DEVICE, 1)
            assert evidence.applied.delay == pytest.approx(0.400, abs=1e-4), "read back from tc"
        link.tc("uplink", "qdisc", "del", "dev", DEVICE, "root")  # put back within a second or so
        broken = link.verify()
        assert [(cause.code, cause.way) for cause in broken.causes] == [("no_qdisc", "uplink")]


def test_a_correlation_that_netem_ignores_is_no_fault() -> None:
    settings = [f"link.{way}.correlation=0.9" for way in DIRECTIONS]
    plan = run.plan(find_experiment("ideal", [*SETTINGS, *settings]), SECONDS, "netem")
    with up(plan, PROFILE.replace("80}", "80, correlation: 0.9}")) as link:
        assert patiently(link).verdict == "believed"


def test_a_doubled_delay_is_named(plan: dict[str, DirectionPlan]) -> None:
    with up(plan, PROFILE.replace("400", "800")) as link:
        doubled = link.verify()
        assert codes(doubled) == {"doubled_delay"}
        for found in doubled.findings.values():
            assert found.evidence.applied is not None
            assert found.evidence.applied.delay == pytest.approx(0.800, abs=1e-4)


def test_a_link_that_delays_one_direction_only_is_named(plan: dict[str, DirectionPlan]) -> None:
    bare = PROFILE.replace("downlink: *both", "downlink: {}")
    with up(plan, bare) as link:
        assert [(c.code, c.way) for c in link.verify().causes] == [("one_direction", "downlink")]


LEAF = f"qdisc change dev {DEVICE} parent 7400:4 handle 7401: netem limit 10000"
# What is asked for beside the delay, and what is done to the kernel, both ways.
FAULTS: dict[str, tuple[list[str], list[str]]] = {
    "no_qdisc": ([], [f"qdisc del dev {DEVICE} root"]),
    "wrong_interface": (
        [],
        [f"qdisc del dev {DEVICE} root", "qdisc add dev lo root netem delay 400ms 80ms"],
    ),
    "shaped_twice": ([], [f"qdisc add dev {DEVICE} parent 7401:1 netem delay 400ms 80ms"]),
    "bypassed": ([], [f"filter del dev {DEVICE} parent 7400:"]),
    "halved_delay": ([], [f"{LEAF} delay 200ms 40ms"]),
    "wrong_jitter": ([], [f"{LEAF} delay 400ms 120ms"]),
    "order_kept": ([], [f"{LEAF} delay 400ms 80ms rate 100gbit"]),
    "no_loss": (["loss=0.3"], [f"{LEAF} delay 400ms 80ms"]),
    "more_loss": (["loss=0.3"], [f"{LEAF} delay 400ms 80ms loss random 90%"]),
    "rate_ignored": (
        ["rate_kbit=2000", "jitter_ms=0", "keep_order=true"],
        [f"{LEAF} delay 400ms 0ms"],
    ),
}
QUICK = ("no_qdisc", "wrong_interface", "shaped_twice", "bypassed")
"""What only a kernel can get wrong; the others are tried in `make test-netem-full`."""


@pytest.mark.parametrize(
    "fault",
    [pytest.param(name, marks=[] if name in QUICK else pytest.mark.full) for name in FAULTS],
)
def test_what_is_wrong_in_the_kernel_is_named(
    plan: dict[str, DirectionPlan], fault: str, figure: Callable[..., None]
) -> None:
    more, commands = FAULTS[fault]
    if more:
        settings = [f"link.{way}.{one}" for way in DIRECTIONS for one in more]
        plan = run.plan(find_experiment("ideal", [*SETTINGS, *settings]), LOSING_SECONDS, "netem")
    with up(plan) as link:
        link.stop()
        for way in DIRECTIONS:
            for command in commands:
                link.tc(way, *command.split())
        found = codes(link.verify())
    figure("seeded faults in the kernel's netem: not named", int(found != {fault}), "==", 0)
    assert found == {fault}
