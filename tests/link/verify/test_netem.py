"""netem verified as between two pods: an honest link, and faults that only a kernel can have."""

from __future__ import annotations

import signal
import subprocess
from contextlib import contextmanager

import pytest

from cloudrc.cli import link_verify
from cloudrc.cli.link_verify import (
    DEVICE,
    HOSTS,
    as_text,
    find_experiment,
    make_plans,
    make_report,
    probe_link,
    run_link,
)
from cloudrc.config.schema import Profile
from cloudrc.errors import CloudrcError, MissingPrerequisiteError

pytestmark = pytest.mark.netem
ASKED = ("delay_ms=400", "jitter_ms=80")  # far above what an emulated machine adds
BOTH = {"delay_ms": 400.0, "jitter_ms": 80.0}
SECONDS = 15.0
"""Time to probe, which a slow machine can [s]."""


class Link:
    """A link that runs, and is probed as often as wanted."""

    def __init__(self, plans, ways):
        self.plans, self.ways = plans, ways

    def verify(self):
        found = probe_link(self.ways, self.plans)
        report = make_report("netem", found, dict.fromkeys(HOSTS, ""))
        print(as_text(report))
        return report

    def stop(self):
        """Stop the link's processes, so that they restore nothing."""
        for way in self.ways.values():
            assert way.process is not None
            way.process.send_signal(signal.SIGSTOP)

    def tc(self, way, *words):
        """Change the kernel behind the back of the link's process."""
        command = ["ip", "netns", "exec", self.ways[way].namespace, "tc", *words]
        subprocess.run(command, check=True, capture_output=True)


def planned(*settings):
    values = dict(one.split("=") for one in (*ASKED, *settings))
    texts = [f"link.{way}.{key}={value}" for way in HOSTS for key, value in values.items()]
    return make_plans(find_experiment("ideal", texts), SECONDS, "netem")


@contextmanager
def running(plans, down=None, **up):
    """Run a link whose processes were told another profile."""
    applied = Profile.model_validate(
        {"uplink": BOTH | up, "downlink": BOTH | up if down is None else down}
    )
    try:
        with run_link(find_experiment("ideal", []), "netem", applied) as ways:
            yield Link(plans, ways)
    except MissingPrerequisiteError as error:
        pytest.exit(f"netem cannot be tested here: {error}", CloudrcError.exit_code + 2)


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    monkeypatch.setattr(link_verify, "START_LIMIT", 300.0)  # emulated processors are slow


def causes(report):
    return [(cause["code"], cause["way"]) for cause in report["causes"]]


def patiently(link):
    """Verify an honest link until it is believed, three times at most: emulation is slow."""
    for _ in range(2):
        if (said := link.verify())["verdict"] == "believed":
            return said
    return link.verify()


@pytest.mark.smoke
def test_an_honest_link_is_believed_but_not_without_its_qdisc():
    with running(planned()) as link:
        said = patiently(link)
        assert said["verdict"] == "believed"
        for found in said["directions"].values():
            known = found["evidence"]
            assert (known["shaper"], known["interface"], known["layers"]) == ("netem", DEVICE, 1)
        link.tc("uplink", "qdisc", "del", "dev", DEVICE, "root")
        assert causes(link.verify()) == [("no_qdisc", "uplink")]


def test_a_correlation_that_netem_ignores_is_no_fault():
    with running(planned("correlation=0.9"), correlation=0.9) as link:
        assert patiently(link)["verdict"] == "believed"


def test_a_doubled_delay_is_named():
    with running(planned(), delay_ms=800.0) as link:
        assert {code for code, _ in causes(link.verify())} == {"doubled_delay"}


def test_a_link_that_delays_one_direction_only_is_named():
    with running(planned(), down={}) as link:
        assert causes(link.verify()) == [("one_direction", "downlink")]


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
def test_what_is_wrong_in_the_kernel_is_named(fault, figure):
    more, commands = FAULTS[fault]
    with running(planned(*more)) as link:
        link.stop()
        for way in HOSTS:
            for command in commands:
                link.tc(way, *command.split())
        found = {code for code, _ in causes(link.verify())}
    figure("seeded faults in the kernel's netem: not named", int(found != {fault}), "==", 0)
    assert found == {fault}
