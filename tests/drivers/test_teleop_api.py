"""The API of a teleop process: kept connections answer at once, idle ones lock nobody out."""

import json
import socket
import statistics
import subprocess
import sys
import time
from contextlib import ExitStack

import pytest

from cloudrc.cli.client import Api
from cloudrc.config.load import dump, load_experiment
from tests.drivers.conftest import LIMIT, TOKEN

pytestmark = pytest.mark.process
FILES = 256
"""Limit of open files that the process starts with."""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    tmp_path = tmp_path_factory.mktemp("teleop")
    (tmp_path / "config.yaml").write_text(dump(load_experiment("hover")))
    (tmp_path / "operator").write_text(TOKEN)
    (tmp_path / "operator").chmod(0o644)
    words = "-m cloudrc teleop --config config.yaml --socket . --tokens . --api-file api.json"
    command = [sys.executable, *words.split(), "--api", "[::1]:0"]
    shell = ["bash", "-c", f'ulimit -Sn {FILES}; exec "$@"', "bash", *command]
    process = subprocess.Popen(shell, cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    limit = time.monotonic() + LIMIT
    while not (tmp_path / "api.json").exists():
        assert time.monotonic() < limit
        time.sleep(0.02)
    url = json.loads((tmp_path / "api.json").read_text())["url"]
    yield "::1", int(url.removeprefix("http://[::1]:"))
    process.terminate()
    _, said = process.communicate(timeout=LIMIT)
    assert process.returncode == 0
    assert "operator can be read by others: chmod 600" in said


def median(ask, count=25):
    times = []
    for _ in range(count):
        began = time.monotonic()
        ask()
        times.append(time.monotonic() - began)
    return statistics.median(times)


def test_a_kept_connection_answers_like_a_fresh_one(address):
    """Both wait for teleop's loop, at most 20 ms; an acknowledgement would delay by 40 ms more."""

    def ask(connection):
        request = f"GET /v1/state HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer {TOKEN}\r\n\r\n"
        connection.sendall(request.encode())
        answer = b""
        while not answer.endswith(b"}"):
            answer += connection.recv(65_536)

    def ask_fresh():
        with socket.create_connection(address) as fresh:
            ask(fresh)

    with socket.create_connection(address) as kept:
        ask(kept)
        assert median(lambda: ask(kept)) < median(ask_fresh) + 0.02


@pytest.mark.promise("emergency-stop-gets-through")
def test_idle_connections_do_not_lock_a_stop_out(address):
    with ExitStack() as idle:
        for _ in range(2 * FILES):
            idle.enter_context(socket.create_connection(address))
        api = Api(f"http://[::1]:{address[1]}", lambda: TOKEN)
        assert api.post("/v1/estop")["state"] == "stopping"
