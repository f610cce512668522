"""Keys and tokens that are known to the test are in nothing that a flight shows or leaves."""

from __future__ import annotations

import base64
import time
import urllib.request
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader

from cloudrc.drivers.local import _free_addresses
from cloudrc.record.writer import McapWriter
from cloudrc.records import Fault
from cloudrc.teleop.auth import Tokens
from cloudrc.tunnel.keys import Key
from tests.drivers.conftest import KEY, TOKEN, Release

OURS = ("operator", "key")
"""The files that may hold them."""


def shapes(secret: bytes) -> Iterator[bytes]:
    """How a secret could be written down."""
    yield secret
    yield secret.hex().encode()
    yield secret.hex().upper().encode()
    yield base64.b64encode(secret).rstrip(b"=")
    yield base64.urlsafe_b64encode(secret).rstrip(b"=")
    yield repr(secret)[2:-1].encode()


CANARIES = [shape for secret in (KEY, TOKEN.encode()) for shape in shapes(secret)]


def found_in(data: bytes) -> list[bytes]:
    return [canary for canary in CANARIES if canary in data]


def what_is_in(path: Path) -> bytes:
    """Its bytes; of a recording, which is compressed, all records as well."""
    data = path.read_bytes()
    if path.suffix != ".mcap":
        return data
    with path.open("rb") as stream:  # records of a torn one as far as they go
        with suppress(McapError):
            for record in StreamReader(stream).records:
                data += bytes(getattr(record, "data", b"")) + repr(record).encode()
    return data


def test_what_a_recording_has_is_seen(tmp_path: Path) -> None:
    """Once among much else, as it would be."""
    path = tmp_path / "a.mcap"
    with McapWriter(path, clock="world") as writer:
        writer.write(Fault(n, "journal", f"line {n}") for n in range(50))
        writer.write([Fault(50, "journal", f"token {TOKEN}")])
    assert found_in(path.read_bytes()) == [], "compressed"
    assert TOKEN.encode() in found_in(what_is_in(path))


@pytest.mark.promise("secrets-stay-secret")
def test_what_holds_a_secret_does_not_show_it(tmp_path: Path) -> None:
    (tmp_path / "operator").write_text(TOKEN)
    for holder in (Key(KEY), Tokens(tmp_path)):
        shown = f"{holder} {holder!r} {[holder]} {getattr(holder, '__dict__', '')}"
        assert found_in(shown.encode()) == []


class Watched(Release):
    """As the release, with metrics, and with recordings."""

    def run(self, *words: str):  # type: ignore[no-untyped-def]
        if words[0] in ("world", "cloud", "teleop"):
            (address,) = _free_addresses(1)
            self.metrics = [*getattr(self, "metrics", []), address]
            words = (*words, "--metrics", address)
        if words[0] in ("world", "cloud"):
            words = (*words, "--record", f"{words[0]}.mcap")
        return super().run(*words)


@pytest.mark.process
@pytest.mark.promise("secrets-stay-secret")
def test_a_flight_shows_and_leaves_none(tmp_path: Path) -> None:
    release = Watched(tmp_path)
    shown: dict[str, bytes] = {}
    try:
        release.fly()
        for name, process in release.running.items():
            for table in ("cmdline", "environ"):
                shown[f"{name} {table}"] = Path(f"/proc/{process.pid}/{table}").read_bytes()
        for address in release.metrics:
            with urllib.request.urlopen(f"http://{address}/metrics", timeout=5.0) as answer:
                shown[f"metrics {address}"] = answer.read()
        release.post("/v1/estop")
        release.until(lambda: release.ask("/v1/state")["seen"]["guard"] == "ESTOP")
        time.sleep(0.5)
    finally:
        for process in release.all:
            process.terminate()
        for number, process in enumerate(release.all):
            out, errors = process.communicate(timeout=20)
            shown[f"output of {number}"] = (out + errors).encode()
    for path in tmp_path.rglob("*"):
        if path.is_file() and path.name not in OURS:
            shown[str(path.relative_to(tmp_path))] = what_is_in(path)
    assert {"world.mcap", "cloud.mcap", "audit.jsonl", "journal/missions"} <= shown.keys()
    assert len(shown["world.mcap"]) > 1000
    assert {place: found_in(data) for place, data in shown.items() if found_in(data)} == {}
