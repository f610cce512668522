# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link verify` of a release, which `helm test` runs, over real HTTP."""

import json
import time
from contextlib import ExitStack, closing
from math import nan
from types import SimpleNamespace

import pytest

from cloudrc.cluster import verify
from cloudrc.cluster.verify import verify_release
from cloudrc.flight.links.verify import OF_PROGRAMS, as_text
from cloudrc.flight.pod.exporter import Exporter
from cloudrc.wire.records import LinkChecked

PAGE = {"shaper": "relay", "reason": "", "interface": "eth0", "netems": {}}
MEASURED = {"ok": 0.0451, "open": 0.0451, "off": 0.0902}


class Release:
    """The exporters of two pods, of their ends and their links."""

    def __init__(self, open_exporter):
        self.ends = {end: open_exporter(end) for end in ("world", "cloud")}
        self.links = {way: open_exporter("link") for way in ("uplink", "downlink")}
        for way, link in self.links.items():
            link.link.shaped("relay", way, "auto", 0.045)
            self.shapes(way, PAGE)

    def hears(self, *, stamp_ns=5, **verdicts):
        """Give ends a verdict on the direction that they receive."""
        for end, verdict in verdicts.items():
            up, value = end == "cloud", MEASURED[verdict]
            rows = [
                LinkChecked(stamp_ns, up, "mean", 0.045, value, 0.043, 0.047, verdict, 3300),
                LinkChecked(stamp_ns, up, "loss", 0.0, 0.0, 0.0, 0.02, "ok", 3300),
            ]
            self.ends[end].see(rows)

    def tells(self, name, asked):
        """Let cloud tell a row that it does not judge."""
        row = LinkChecked(5, True, name, asked, nan, 0.0, 0.0, "told", 3300)
        self.ends["cloud"].see([row])

    def shapes(self, way, page):
        self.links[way].link.tell = lambda: json.dumps(page)

    def ask(self, limit=30.0):
        pods = {}
        for end, link in zip(self.ends, self.links.values(), strict=True):
            ports = self.ends[end].port, link.port
            pods[end] = tuple(f"http://127.0.0.1:{port}" for port in ports)
        return verify_release("demo", pods, limit)


@pytest.fixture
def release(monkeypatch):
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:9")  # a proxy is not used
    monkeypatch.setattr(verify.time, "sleep", lambda seconds: None)
    with ExitStack() as stack:

        def open_exporter(role):
            exporter = stack.enter_context(closing(Exporter(role)))
            exporter.port = exporter.serve(("127.0.0.1", 0))
            return exporter

        yield Release(open_exporter)


def causes(said):
    return [(cause["code"], cause["way"]) for cause in said["causes"]]


def test_a_release_is_verified_once_both_ends_do(release):
    release.hears(world="ok", cloud="ok")
    said = release.ask()
    assert (said["verdict"], said["shaper"]) == ("believed", "shaped by relay")
    (mean,) = (row for row in said["directions"]["uplink"]["rows"] if row["name"] == "mean")
    assert mean["measured"] == pytest.approx(0.0451)
    assert as_text(said).splitlines()[-1].startswith("VERIFIED")


def test_a_fault_names_its_direction(release):
    release.hears(world="off", cloud="ok")
    said = release.ask()
    assert said["verdict"] == "not believed"
    assert causes(said) == [("doubled_delay", "downlink")]
    assert "mean 90.20 ms instead of 45.00 ms" in as_text(said)
    for way in release.links:
        release.shapes(way, PAGE | {"netems": {"eth0": [{"kind": "netem"}]}})
    release.hears(cloud="off")
    assert causes(release.ask()) == [("shaped_twice", "both")], "qdiscs that the links find"


def test_a_verdict_off_for_a_moment_does_not_end_the_wait(release, monkeypatch):
    release.hears(world="ok", cloud="open")
    undecided = release.ask(0.0)
    assert as_text(undecided).endswith("(--seconds) for mean of the uplink")
    said = as_text(undecided, more=OF_PROGRAMS)
    assert said.endswith("(send more, or run longer) for mean of the uplink")
    release.hears(world="off", cloud="open")
    later = iter([{}, {}, {"stamp_ns": 6, "world": "ok"}, {}, {"stamp_ns": 6, "cloud": "ok"}])
    clock = SimpleNamespace(monotonic=time.monotonic, sleep=lambda _: release.hears(**next(later)))
    monkeypatch.setattr(verify, "time", clock)
    assert release.ask()["verdict"] == "believed"


def test_what_is_not_judged_is_noted(release):
    release.hears(world="ok")
    release.tells("time_line", 1.0)
    said = release.ask(0.0)
    assert said["verdict"] == "undecided"
    assert "uplink: time_line NOT JUDGED; docs/verify.md says why" in as_text(said)
    release.hears(cloud="ok")
    assert as_text(release.ask()).endswith("except what is NOT JUDGED (above)")
