# SPDX-License-Identifier: Apache-2.0

"""The API of a teleop process with few open files: idle connections lock nobody out."""

import json
import socket
import subprocess
import sys
from contextlib import ExitStack

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.teleop.client import Api
from tests.conftest import needs_ipv6, wait_until
from tests.flight.conftest import LIMIT, TOKEN

FILES = 256
"""Limit of open files that the process starts with."""


@needs_ipv6
@pytest.mark.process
@pytest.mark.promise("emergency-stop-gets-through")
def test_idle_connections_do_not_lock_a_stop_out(tmp_path):
    (tmp_path / "config.yaml").write_text(dump(load_experiment("hover")))
    (tmp_path / "operator").write_text(TOKEN)
    (tmp_path / "operator").chmod(0o644)
    words = (
        "-m cloudrc process teleop --config config.yaml --socket . --tokens . --api-file api.json"
    )
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
    process.terminate()
    _, said = process.communicate(timeout=LIMIT)
    assert process.returncode == 0
    assert "operator can be read by others: chmod 600" in said
