"""`cloudrc link verify --ends`, which `helm test` runs, over real HTTP."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Any

import pytest

from cloudrc.cli import link_verify
from cloudrc.cli.link_verify import Report, as_text, fetch, verify_release
from cloudrc.drivers.exporter import Exporter
from cloudrc.errors import TimedOutError
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Near, Told, write_told
from cloudrc.records import LinkChecked

APPLIED = DirectionProfile(0.045, loss=0.02, duplicate=0.01, rate=3e6)


@dataclass
class Release:
    """The exporters of two pods."""

    world: Exporter
    cloud: Exporter
    links: dict[str, Exporter]
    pods: dict[str, tuple[str, str]]
    looks: int = 0

    def hears(self, end: str, mean: str, *, trip: bool = False, stamp_ns: int = 5) -> None:
        """Give an end a verdict on the direction that it receives."""
        exporter, uplink = (self.cloud, True) if end == "cloud" else (self.world, False)
        measured = {"ok": 0.0451, "open": 0.0451, "off": 0.0902}[mean]
        name = "round_trip" if trip else "mean"
        exporter.see(
            [
                LinkChecked(stamp_ns, uplink, name, 0.045, measured, 0.043, 0.047, mean, 3300),
                LinkChecked(stamp_ns, uplink, "loss", 0.0, 0.0, 0.0, 0.02, "ok", 3300),
            ]
        )

    def count(self, seconds: float) -> None:
        """Let time pass until the next poll."""
        self.looks += 1


@pytest.fixture
def release(monkeypatch: pytest.MonkeyPatch) -> Iterator[Release]:
    with ExitStack() as open_ones:

        def served(role: str) -> tuple[Exporter, str]:
            exporter = open_ones.enter_context(closing(Exporter(role)))
            return exporter, f"http://127.0.0.1:{exporter.serve(('127.0.0.1', 0))}"

        (world, at_world), (cloud, at_cloud) = served("world"), served("cloud")
        (up, at_up), (down, at_down) = served("link"), served("link")
        for link, way in ((up, "uplink"), (down, "downlink")):
            link.shaped("relay", way, "auto")
            link.tells(lambda: write_told(Told("relay", "", APPLIED, Near("eth0", {}))))
        pods = {"world": (at_world, at_up), "cloud": (at_cloud, at_down)}
        made = Release(world, cloud, {"uplink": up, "downlink": down}, pods)
        monkeypatch.setattr(link_verify.time, "sleep", made.count)
        monkeypatch.setattr("cloudrc.drivers.exporter.KEPT", 0.0)  # as no time passes
        yield made


@pytest.fixture
def proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Name a proxy that does not answer."""
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")


def test_a_proxy_of_the_environment_is_not_used(release: Release, proxy: None) -> None:
    assert "cloudrc_link_info" in fetch(f"{release.pods['world'][1]}/metrics")


def ask(release: Release, limit: float = 30.0) -> Report:
    return verify_release("demo", release.pods, limit, lambda line: None)


def causes(report: Report) -> list[tuple[str, str]]:
    return [(cause["code"], cause["way"]) for cause in report["causes"]]


def rows(report: Report) -> dict[str, Any]:
    return {row["name"]: row for row in report["directions"]["uplink"]["rows"]}


def test_a_release_is_believed_once_both_ends_do(release: Release) -> None:
    release.hears("world", "ok")
    release.hears("cloud", "ok")
    said = ask(release)
    assert said["verdict"] == "believed"
    assert said["shaper"] == "shaped by relay"
    assert rows(said)["mean"]["applied"] == pytest.approx(0.0456, abs=1e-4), (
        "including the transmission time"
    )
    assert rows(said)["loss"]["applied"] == pytest.approx(0.02, abs=0.01)
    assert as_text(said).splitlines()[-1].startswith("BELIEVED")


def test_a_fault_names_its_direction(release: Release) -> None:
    release.hears("world", "off")
    release.hears("cloud", "ok")
    said = ask(release)
    assert said["verdict"] == "not believed"
    assert causes(said) == [("doubled_delay", "downlink")]


@pytest.mark.parametrize(
    ("shaper", "leaves", "code"),
    [("relay", "eth0", "shaped_twice"), ("netem", "eth1", "wrong_interface")],
)
def test_qdiscs_that_the_links_find_are_named(
    release: Release, shaper: str, leaves: str, code: str
) -> None:
    near = Near(leaves, {"eth0": [{"kind": "netem"}]})
    for link in release.links.values():
        link.tells(lambda: write_told(Told(shaper, "", APPLIED, near)))
    release.hears("world", "off")
    release.hears("cloud", "off")
    assert causes(ask(release)) == [(code, "both")]


@pytest.mark.parametrize(("applied", "told_so"), [(0.090, True), (0.0452, False)])
def test_a_wrong_setting_differs_from_a_wrong_shaper(
    release: Release, applied: float, told_so: bool
) -> None:
    said = write_told(Told("relay", "", DirectionProfile(applied)))
    release.links["downlink"].tells(lambda: said)
    release.hears("world", "off")
    release.hears("cloud", "ok")
    (cause,) = ask(release)["causes"]
    assert cause["code"] == "doubled_delay"
    assert f"the shaper says {applied * 1e3:.2f} ms" in cause["text"]
    assert ("it was told so" in cause["text"]) is told_so


def test_once_one_direction_is_off_the_wait_is_short(
    release: Release, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_verify, "OFF_TIMEOUT", 0.0)
    release.hears("world", "off")
    release.hears("cloud", "open")
    assert ask(release, limit=5.0)["verdict"] == "not believed"
    assert release.looks <= 3, "once at the start, once it is off"


def test_a_verdict_off_for_a_moment_does_not_end_the_wait(
    release: Release, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(link_verify, "OFF_TIMEOUT", 0.05)
    release.hears("world", "off")
    release.hears("cloud", "open")
    began = time.monotonic()

    def recover(seconds: float) -> None:
        release.count(seconds)
        if release.looks > 2:
            release.hears("world", "ok", stamp_ns=6)
        if time.monotonic() - began > 0.2:
            release.hears("cloud", "ok", stamp_ns=6)

    monkeypatch.setattr(link_verify.time, "sleep", recover)
    assert ask(release)["verdict"] == "believed"


def test_a_link_without_status_leaves_applied_values_open(release: Release) -> None:
    release.links["uplink"].tells(lambda: "{}")
    release.hears("world", "ok")
    release.hears("cloud", "ok")
    said = ask(release)
    assert said["verdict"] == "believed"
    assert all("applied" not in row for row in rows(said).values())


def test_without_commands_it_says_to_fly_first(release: Release) -> None:
    release.hears("cloud", "ok")
    said = ask(release, 0.0)
    assert said["verdict"] == "undecided"
    assert any("fly a mission first" in note for note in said["notes"])


def test_a_verdict_by_round_trips_is_noted(release: Release) -> None:
    release.hears("world", "ok")
    release.hears("cloud", "ok", trip=True)
    assert "do not share a clock" in "".join(ask(release)["notes"])


def test_what_the_ends_cannot_judge_is_noted(release: Release) -> None:
    release.hears("world", "ok")
    release.hears("cloud", "ok")
    for name, asked in (("rate", 3e6), ("time_line", 1.0), ("correlation", 0.9)):
        row = LinkChecked(5, True, name, asked, math.nan, math.nan, math.nan, "told", 3300)
        release.cloud.see([row])
    said = ask(release)
    text = as_text(said)
    assert said["verdict"] == "believed"
    assert "uplink: rate NOT JUDGED" in text
    assert "uplink: its time line NOT JUDGED" in text
    assert "uplink: correlation 0.9 NOT JUDGED: netem realises almost none of it" in text
    assert text.splitlines()[-1].endswith("except what is NOT JUDGED (above)")


@pytest.mark.parametrize(
    ("asked", "applied", "code"),
    [(2e6, 3e6, "rate_ignored"), (2e6, None, "rate_ignored"), (5e6, 3e6, "slow")],
)
def test_a_shaper_that_reports_another_rate_is_not_believed(
    release: Release, asked: float, applied: float | None, code: str
) -> None:
    """Single datagrams do not measure the rate."""
    said_so = write_told(Told("relay", "", DirectionProfile(0.045, rate=applied)))
    release.links["uplink"].tells(lambda: said_so)
    release.hears("world", "ok")
    release.hears("cloud", "ok")
    release.cloud.see([LinkChecked(5, True, "rate", asked, math.nan, 0.0, 0.0, "told", 3300)])
    said = ask(release)
    assert said["verdict"] == "not believed"
    assert causes(said) == [(code, "uplink")]
    applied_text = f"{applied * 1e-3:.0f} kbit/s" if applied else "no limit"
    assert f"the shaper says {applied_text} instead of" in said["causes"][0]["text"]
    assert "NOT JUDGED" not in as_text(said)


def test_an_undecided_verdict_says_how_long_it_takes(release: Release) -> None:
    release.hears("world", "ok")
    release.hears("cloud", "open")
    release.cloud.see([LinkChecked(5, True, "datagrams", 8800, 3300, 0.0, 0.0, "told", 3300)])
    said = ask(release, 0.0)
    assert said["verdict"] == "undecided"
    assert "uplink: 3300 of 8800 datagrams, 55 s more" in said["notes"]


def test_ends_that_do_not_answer_are_a_timeout(release: Release) -> None:
    release.world.close()
    with pytest.raises(TimedOutError, match="world did not answer"):
        ask(release, 0.0)
