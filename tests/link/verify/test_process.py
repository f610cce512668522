"""`cloudrc link verify` on real sockets and processes: what it believes, and what it names."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

from cloudrc.assembly import link_profile
from cloudrc.cli.link_processes import LOOPBACK, ShaperProcess
from cloudrc.cli.link_verify import find_experiment
from cloudrc.cli.link_verify_run import open_probe_endpoints, verify
from cloudrc.cli.link_verify_text import VerifyReport, as_document, as_text, deciding
from cloudrc.cli.main import main
from cloudrc.config.schema import Profile

pytestmark = pytest.mark.process
SECONDS = 4.0
# Far above what a machine adds that does other things, too.
LINK = ["link.uplink.delay_ms=100", "link.uplink.jitter_ms=40", "link.downlink.delay_ms=80"]
LINK += ["link.downlink.jitter_ms=30"]


def asked(*settings: str) -> Any:
    return find_experiment("paper-p1", [*LINK, *settings])


def nobody(line: str) -> None:
    """Nobody watches."""


def changed(experiment: Any, **values: Any) -> Profile:
    """The profile of an experiment with other values both ways: a fault."""
    ways = {
        way: getattr(experiment, way).model_copy(update=values) for way in ("uplink", "downlink")
    }
    return Profile(**ways)


def steady(make: Callable[[], VerifyReport], wanted: set[str] | None = None) -> VerifyReport:
    """Verify until the machine has let the shapers run, three times at most.

    It may stand still without a shaper's knowing, when whoever hears is held up: then something
    else is named than what is wanted.
    """
    said = make()
    for _ in range(2):
        if "throttled" not in codes(said) and (wanted is None or codes(said) == wanted):
            break
        said = make()
    return said


def codes(said: VerifyReport) -> set[str]:
    return {cause.code for cause in said.causes}


def test_a_true_link_is_believed_unless_the_machine_holds_it_up() -> None:
    said = steady(lambda: verify(asked(), "mine", "relay", SECONDS, nobody))
    if codes(said) != {"throttled"}:  # the suite runs on machines that do other things, too
        assert said.verdict == "believed", as_text(said)
    for found in said.findings.values():
        assert found.evidence.shaper == "relay"
        assert found.evidence.applied == link_profile(
            asked().uplink if found is said.findings["uplink"] else asked().downlink
        ), "read back from its state"
        counted = found.evidence.passed + found.evidence.unread
        assert counted == found.evidence.sent or codes(said) == {"throttled"}
        assert all(row.low <= row.asked <= row.high for row in deciding(found.rows))
    report = json.loads(json.dumps(as_document(said)))
    assert report["verdict"] == said.verdict
    assert {row["name"] for row in report["directions"]["uplink"]["rows"]} >= {"mean", "loss"}


def test_a_doubled_delay_is_named_on_the_command_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = asked()
    wrong = Profile(
        uplink=experiment.uplink.model_copy(update={"delay_ms": 200.0}),
        downlink=experiment.downlink.model_copy(update={"delay_ms": 160.0}),
    )
    from cloudrc.cli import link_verify_run

    def doubled(*given: Any) -> VerifyReport:
        return steady(lambda: verify(*given, applied=wrong))

    monkeypatch.setattr(link_verify_run, "verify", doubled)
    words = ["link", "verify", "paper-p1", "--seconds", "4"]
    assert main([*words, *[word for value in LINK for word in ("--set", value)]]) == 1
    shown = capsys.readouterr().out
    assert shown.splitlines()[-1].startswith("NOT BELIEVED")
    assert "[doubled_delay]" in shown
    assert "it was told so" in shown


@contextmanager
def stopped_now_and_then(running: Mapping[str, ShaperProcess]) -> Iterator[None]:
    """Hold both shapers up, as a CPU limit does: 60 ms of every 100."""
    over = threading.Event()

    def throttle() -> None:
        while not over.wait(0.04):
            for number in (signal.SIGSTOP, signal.SIGCONT):
                for one in running.values():
                    one.process.send_signal(number)  # nothing, if it has ended
                over.wait(0.06 if number == signal.SIGSTOP else 0.0)

    thread = threading.Thread(target=throttle)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


@pytest.mark.full
def test_a_relay_without_its_cpu_is_named() -> None:
    holds: list[Any] = []

    def meddle(running: Mapping[str, ShaperProcess]) -> None:
        holds.append(stopped_now_and_then(running))
        holds[0].__enter__()

    try:
        said = verify(asked(), "mine", "relay", SECONDS, nobody, meddle=meddle)
    finally:
        holds[0].__exit__(None, None, None)
    assert said.verdict == "not believed"
    assert codes(said) == {"throttled"}, as_text(said)


@pytest.mark.full
def test_a_bypass_is_named() -> None:
    direct: dict[str, tuple[str, int]] = {}

    def around(running: Mapping[str, ShaperProcess]) -> None:
        direct.update({way: one.place.peer for way, one in running.items()})

    said = steady(
        lambda: verify(asked(), "mine", "relay", SECONDS, nobody, meddle=around, routes=direct)
    )
    assert codes(said) == {"bypassed"}, as_text(said)


FAULTS: dict[str, tuple[list[str], Callable[[Any], Profile]]] = {
    "halved_delay": (
        [],
        lambda e: Profile(
            uplink=e.uplink.model_copy(update={"delay_ms": 50.0, "jitter_ms": 20.0}),
            downlink=e.downlink.model_copy(update={"delay_ms": 40.0, "jitter_ms": 15.0}),
        ),
    ),
    "one_direction": (
        [],
        lambda e: Profile(uplink=e.uplink),
    ),
    "wrong_jitter": (
        [],
        lambda e: Profile(
            uplink=e.uplink.model_copy(update={"jitter_ms": 50.0}),
            downlink=e.downlink.model_copy(update={"jitter_ms": 38.0}),
        ),
    ),
    "no_loss": (
        ["link.uplink.loss=0.2", "link.downlink.loss=0.2"],
        lambda e: changed(e, loss=0.0),
    ),
    "more_loss": (
        ["link.uplink.loss=0.1", "link.downlink.loss=0.1"],
        lambda e: changed(e, loss=0.3),
    ),
    "order_kept": ([], lambda e: changed(e, keep_order=True)),
    "rate_ignored": (
        ["link.uplink.rate_kbit=4000", "link.uplink.keep_order=true", "link.uplink.jitter_ms=3"],
        lambda e: changed(e, rate_kbit=None),
    ),
}


@pytest.mark.full
@pytest.mark.parametrize("fault", FAULTS)
def test_a_seeded_fault_is_named(fault: str) -> None:
    settings, make = FAULTS[fault]
    experiment = asked(*settings)
    applied = make(experiment)
    if fault == "rate_ignored":
        applied = applied.model_copy(update={"downlink": experiment.downlink})
    said = steady(
        lambda: verify(experiment, "mine", "relay", SECONDS, nobody, applied=applied), {fault}
    )
    # A machine that does other things, too, may hold the shapers up each time.
    assert {fault} <= codes(said) <= {fault, "throttled"}, as_text(said)


def test_a_link_that_cannot_shape_is_a_missing_prerequisite(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)  # root may have netem
    assert main(["link", "verify", "ideal", "--shaper", "netem"]) == 3
    assert "root" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nonsense"], "no profile or experiment named 'nonsense'"),
        (["ideal", "--seconds", "0"], "--seconds 0"),
        (["no/such.yaml"], "no such file"),
    ],
)
def test_bad_input_is_told_in_one_line(
    words: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["link", "verify", *words]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert len(said.strip().splitlines()) == 1


def test_nothing_is_left_open() -> None:
    with open_probe_endpoints("relay") as ends:
        address = ends["uplink"].own.getsockname()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as again:
        again.bind((LOOPBACK, address[1]))
