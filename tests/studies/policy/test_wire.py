# SPDX-License-Identifier: Apache-2.0

"""Client and server of openpi's wire, over loopback."""

import shutil
import socket
import subprocess
import sys
import threading
import urllib.request

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosedError, InvalidStatus
from websockets.sync.client import connect

from cloudrc.base.errors import CloudrcError
from cloudrc.flight.pod.openpi.client import PolicyClient, PolicyServerError, SilentServerError
from tests.studies.policy.conftest import actions, serving, stock_like

STATE = {"state": np.arange(3.0)}


def test_a_client_gets_the_actions_of_the_served_policy(policy):
    with serving(policy()) as url, PolicyClient(url) as client:
        first, second = client.infer(STATE), client.infer(STATE)
    assert client.metadata == {}
    assert first["actions"].tolist() == [[0, 1, 2], [0, 1, 2]]
    assert first["server_timing"].keys() == {"infer_ms"}
    assert second["server_timing"].keys() == {"infer_ms", "prev_total_ms"}


def test_a_policy_may_be_an_object_with_metadata(policy):
    source = """
class Policy:
    metadata = {"robot": "arm"}
    def infer(self, observation):
        return {"actions": [[1.0]], "more": "x"}
def build():
    return Policy()
"""
    with serving(policy(source)) as url, PolicyClient(url) as client:
        assert client.metadata == {"robot": "arm"}
        answer = client.infer({})
    assert answer["actions"].tolist() == [[1.0]]
    assert answer["more"] == "x"


COUNTING = """
count = 0
def reset():
    global count
    count = 0
def infer(observation):
    global count
    count += 1
    return {"actions": [[count]]}
"""


def test_a_policy_is_reset_for_each_connection_and_serves_one_at_a_time(policy):
    with serving(policy(COUNTING)) as url:
        with PolicyClient(url) as client:
            assert [client.infer({})["actions"].item() for _ in range(2)] == [1, 2]
            with pytest.raises(SilentServerError, match=r"no metadata within 0\.05 s"):
                PolicyClient(url, start_limit=0.05)
        with PolicyClient(url) as client:
            assert client.infer({})["actions"].item() == 1


def test_health_is_answered_without_a_key_and_a_policy_with_it_only(policy):
    with serving(policy(), key="secret") as url:
        with urllib.request.urlopen(f"{url.replace('ws', 'http')}/healthz") as answer:
            assert (answer.status, answer.read()) == (200, b"OK\n")
        for key in ("", "wrong"):
            with pytest.raises(PolicyServerError, match="CLOUDRC_POLICY_KEY"):
                PolicyClient(url, key=key)
        PolicyClient(url, key="secret").close()


def test_a_page_in_a_browser_does_not_reach_a_policy(policy):
    with serving(policy()) as url, pytest.raises(InvalidStatus, match="403"):
        connect(url, origin="https://example.org").__enter__()


FAILING = """
def infer(observation):
    kind = observation["kind"]
    if kind == "raise":
        raise RuntimeError("no such thing")
    return {"shape": {"actions": [1.0]}, "none": None, "nan": {"actions": [[float("nan")]]},
            "object": {"actions": [[1.0]], "x": object()}}[kind]
"""


@pytest.mark.parametrize(
    ("kind", "text"),
    [
        ("raise", "RuntimeError: no such thing"),
        ("shape", r"shape \(1,\)"),
        ("nan", "not a finite number"),
    ],
)
def test_a_failing_policy_tells_its_client_and_serves_the_next(policy, kind, text):
    log = []
    with serving(policy(FAILING), log) as url:
        with connect(url) as stock:
            stock.recv()
            stock.send(msgpack.packb({"kind": kind}))
            assert isinstance(stock.recv(), str)
            with pytest.raises(ConnectionClosedError) as closed:
                stock.recv()
        assert closed.value.rcvd.code == 1011
        with PolicyClient(url) as client, pytest.raises(PolicyServerError, match=text):
            client.infer({"kind": kind})
    assert len(log) == 2
    assert all("\n" not in line for line in log)


@pytest.mark.parametrize("frame", ["text", b"\xc1"])
def test_a_wrong_frame_of_a_client_is_answered_with_an_error(policy, frame):
    with serving(policy()) as url, connect(url) as stock:
        stock.recv()
        stock.send(frame)
        assert "WireError" in stock.recv()


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        ("Traceback\n  File\nValueError: bad prompt\n", "error: ValueError: bad prompt$"),
        (b"\xc1", "cannot be read"),
    ],
)
def test_a_wrong_answer_ends_the_connection_with_one_line(answer, text):
    with stock_like(lambda connection, frame: answer) as url, PolicyClient(url) as client:
        with pytest.raises(PolicyServerError, match=text) as raised:
            client.infer(STATE)
        assert "\n" not in str(raised.value)
        with pytest.raises(SilentServerError, match="closed"):
            client.infer(STATE)


def test_a_late_answer_is_not_taken_for_the_next_one():
    late = threading.Event()

    def answer(connection, frame):
        late.wait(5)
        return actions(1.0)

    with stock_like(answer) as url, PolicyClient(url, start_limit=1) as client:
        client._limit = 0.05
        with pytest.raises(SilentServerError, match=r"no answer within 0\.05 s"):
            client.infer(STATE)
        late.set()
        with pytest.raises(SilentServerError, match="closed"):
            client.infer(STATE)


def test_nobody_listening_and_other_servers_are_one_line():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        free = taken.getsockname()[1]
        with pytest.raises(CloudrcError, match="does not accept the connection within"):
            PolicyClient(f"ws://127.0.0.1:{free}", start_limit=0.2)
    with pytest.raises(SilentServerError, match="nobody listens"):
        PolicyClient(f"ws://127.0.0.1:{free}")
    with pytest.raises(PolicyServerError, match="no connection"):
        PolicyClient("ws://no-such-host.invalid:1")


STOCK = """
import sys
import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

client = WebsocketClientPolicy("127.0.0.1", int(sys.argv[1]), api_key="secret")
assert client.get_server_metadata() == {"robot": "arm"}
image = np.full((224, 224, 3), 7, np.uint8)
observation = {"image": image, "state": np.arange(3, dtype="f4"), "x": np.float32(2)}
observation["prompt"] = "go"
answer = client.infer(observation)
assert answer["actions"].tolist() == [[0, 1, 2]], answer
assert answer["image"].dtype == np.uint8 and (answer["image"] == image).all()
try:
    client.infer({})
except RuntimeError as error:
    assert "KeyError" in str(error), error
else:
    raise AssertionError("no error")
print("passed")
"""


@pytest.fixture
def stock(tmp_path):
    """Install packages of openpi into an environment of their own; return its Python.

    They pin an old numpy, and forget to ask for typing_extensions. Needs a package index.
    """
    environment = tmp_path / "openpi"

    def install(*packages):
        subprocess.run([sys.executable, "-m", "venv", environment], check=True)
        words = [environment / "bin/pip", "install", "--quiet", *packages, "typing_extensions"]
        subprocess.run(words, check=True)
        return environment / "bin/python"

    yield install
    shutil.rmtree(environment)


@pytest.mark.full
def test_the_stock_client_of_openpi_talks_to_our_server(policy, stock):
    source = """
metadata = {"robot": "arm"}
def infer(observation):
    return {"actions": observation["state"][None, :], "image": observation["image"]}
"""
    python = stock("openpi-client==0.1.2")
    with serving(policy(source), key="secret") as url:
        words = [python, "-c", STOCK, url.rpartition(":")[2]]
        done = subprocess.run(words, capture_output=True, text=True)
    assert done.stdout == "passed\n", done.stderr
