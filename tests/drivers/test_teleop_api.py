"""The API of a teleop process with few open files: idle connections lock nobody out."""

import json
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, closing
from http.client import HTTPConnection
from statistics import median

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.teleop.client import Api
from tests.conftest import needs_ipv6, wait_until
from tests.drivers.conftest import LIMIT, TOKEN

FILES = 256
"""Limit of open files that the process starts with."""


def answer_times(port, count):
    """Ask `count` times over one connection for the state; return the times to the answers [s]."""
    headers, times = {"Authorization": f"Bearer {TOKEN}"}, []
    with closing(HTTPConnection("::1", port)) as connection:
        for _ in range(count):
            began = time.monotonic()
            connection.request("GET", "/v1/state", headers=headers)
            assert connection.getresponse().read()
            times.append(time.monotonic() - began)
    return times


@needs_ipv6
@pytest.mark.process
@pytest.mark.promise("emergency-stop-gets-through")
def test_idle_connections_do_not_lock_a_stop_out(tmp_path):
    (tmp_path / "config.yaml").write_text(dump(load_experiment("hover")))
    (tmp_path / "operator").write_text(TOKEN)
    (tmp_path / "operator").chmod(0o644)
    words = "-m cloudrc teleop --config config.yaml --socket . --tokens . --api-file api.json"
    command = [sys.executable, *words.split(), "--api", "[::1]:0"]
    shell = ["bash", "-c", f'ulimit -Sn {FILES}; exec "$@"', "bash", *command]
    process = subprocess.Popen(shell, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    wait_until((tmp_path / "api.json").exists, LIMIT)
    url = json.loads((tmp_path / "api.json").read_text())["url"]
    with ExitStack() as idle:
        for _ in range(2 * FILES):
            port = int(url.removeprefix("http://[::1]:"))
            idle.enter_context(socket.create_connection(("::1", port)))
        assert Api(url, lambda: TOKEN).post("/v1/estop")["state"] == "stopping"
    fresh = median(median(answer_times(port, 1)) for _ in range(20))
    kept = median(answer_times(port, 20))
    assert kept < fresh + 0.015, "a kept connection waits for no acknowledgement"
    process.terminate()
    _, said = process.communicate(timeout=LIMIT)
    assert process.returncode == 0
    assert "operator can be read by others: chmod 600" in said
