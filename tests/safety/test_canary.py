# SPDX-License-Identifier: Apache-2.0

"""No output and no file of a flight contains its key or its token."""

import base64
import urllib.request
from contextlib import suppress
from pathlib import Path

import pytest
from mcap.exceptions import McapError
from mcap.stream_reader import StreamReader

from cloudrc.flight.pod.realtime import free_ports
from tests.flight.conftest import KEY, TOKEN, Release

SECRET_FILES = ("operator", "key")
CANARIES = [
    form
    for secret in (KEY, TOKEN.encode())
    for form in (
        *(secret, secret.hex().encode(), secret.hex().upper().encode()),
        *(encode(secret).rstrip(b"=") for encode in (base64.b64encode, base64.urlsafe_b64encode)),
        repr(secret)[2:-1].encode(),
    )
]


def found_in(data):
    return [canary for canary in CANARIES if canary in data]


def content_of(path):
    """Return the bytes of a file; of a recording, also its decompressed records."""
    data = path.read_bytes()
    if path.suffix == ".mcap":
        with path.open("rb") as stream, suppress(McapError):  # a truncated recording ends early
            for record in StreamReader(stream).records:
                data += bytes(getattr(record, "data", b"")) + repr(record).encode()
    return data


class ObservedRelease(Release):
    """A release with metrics."""

    def run(self, *words):
        if words[0] == "process":
            address = f"127.0.0.1:{free_ports(1)[0]}"
            self.metrics = [*getattr(self, "metrics", []), address]
            words = (*words, "--metrics", address)
        return super().run(*words)


@pytest.mark.process
@pytest.mark.promise("secrets-stay-secret")
def test_a_flight_exposes_no_secret(tmp_path):
    release = ObservedRelease(tmp_path)
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
    finally:
        for process in release.all:
            process.terminate()
        for number, process in enumerate(release.all):
            out, _ = process.communicate(timeout=20)
            shown[f"output of {number}"] = out.encode()
    for path in tmp_path.rglob("*"):
        if path.is_file() and path.name not in SECRET_FILES:
            shown[str(path.relative_to(tmp_path))] = content_of(path)
    assert {"world.mcap", "cloud.mcap", "journal/missions"} <= shown.keys()
    assert b"position" in shown["world.mcap"], "it is decompressed"
    assert {place: found_in(data) for place, data in shown.items() if found_in(data)} == {}
