# SPDX-License-Identifier: Apache-2.0

"""`link verify` with netem: an honest link, and faults that only a kernel can have."""

import signal
import subprocess
from contextlib import contextmanager

import pytest

from cloudrc.base.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.flight.links import under_test
from cloudrc.flight.links.under_test import DEVICE, HOSTS, run_link
from cloudrc.flight.links.verify import (
    as_text,
    find_experiment,
    make_plans,
    make_report,
    probe_link,
)

pytestmark = pytest.mark.netem
ASKED = ("delay_ms=400", "jitter_ms=80")  # far above what an emulated machine adds


def verify(ways, plans):
    report = make_report("netem", probe_link(ways, plans))
    print(as_text(report))
    return report


def change(way, command):
    """Change the qdiscs without the link's process."""
    words = ["ip", "netns", "exec", way.namespace, "tc", *command.split()]
    subprocess.run(words, check=True, capture_output=True)


def planned(*settings):
    values = dict(one.split("=") for one in (*ASKED, *settings))
    texts = [f"link.{way}.{key}={value}" for way in HOSTS for key, value in values.items()]
    return make_plans(find_experiment("ideal", texts), 15.0, "netem")  # seconds


@contextmanager
def running():
    """Run a link with the delay and jitter of `ASKED`, but no other requested property."""
    settings = [f"link.{way}.{setting}" for way in HOSTS for setting in ASKED]
    try:
        with run_link(find_experiment("ideal", settings), "netem") as ways:
            yield ways
    except MissingPrerequisiteError as error:
        pytest.exit(f"netem cannot be tested here: {error}", CloudrcError.exit_code + 2)


@pytest.fixture(autouse=True)
def patience(monkeypatch):
    monkeypatch.setattr(under_test, "START_LIMIT", 300.0)  # emulated processors are slow


@pytest.mark.smoke
def test_an_honest_link_is_verified_but_not_without_its_qdisc():
    with running() as ways:
        for _ in range(3):  # emulation is slow
            if (said := verify(ways, planned()))["verdict"] == "believed":
                break
        assert said["verdict"] == "believed"
        for found in said["directions"].values():
            known = found["evidence"]
            assert (known["shaper"], known["interface"], known["layers"]) == ("netem", DEVICE, 1)
        change(ways["uplink"], f"qdisc del dev {DEVICE} root")
        # On a slow processor, the other direction may have a cause of its own.
        cause, *_ = verify(ways, planned())["causes"]
        assert (cause["code"], cause["way"]) == ("no_qdisc", "uplink")


LEAF = f"qdisc change dev {DEVICE} parent 7400:4 handle 7401: netem limit 10000"
# What is asked for beside the delay, and what is done to the kernel, both ways.
FAULTS = {
    "no_qdisc": ([], [f"qdisc del dev {DEVICE} root"]),
    "wrong_interface": (
        [],
        [f"qdisc del dev {DEVICE} root", "qdisc add dev lo root netem delay 400ms 80ms"],
    ),
    "shaped_twice": ([], [f"qdisc add dev {DEVICE} parent 7401:1 netem delay 400ms 80ms"]),
    "bypassed": ([], [f"filter del dev {DEVICE} parent 7400:"]),
    "doubled_delay": ([], [f"{LEAF} delay 800ms 80ms"]),
    "more_loss": (["loss=0.3"], [f"{LEAF} delay 400ms 80ms loss random 90%"]),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_in_the_kernel_is_named(fault):
    more, commands = FAULTS[fault]
    with running() as ways:
        for way in ways.values():
            way.process.send_signal(signal.SIGSTOP)  # so that it does not report the change
            for command in commands:
                change(way, command)
        found = {cause["code"] for cause in verify(ways, planned(*more))["causes"]}
    assert found == {fault}
