# SPDX-License-Identifier: Apache-2.0

"""Servers of policies for tests: ours, and one like openpi's, which behaves as a test says."""

import asyncio
import threading
from contextlib import contextmanager, suppress

import msgpack
import numpy as np
import pytest
from websockets.sync.server import serve

from cloudrc.studies.policy.serve import PolicyServer

POLICY = """
import numpy as np

def infer(observation):
    return {"actions": np.ones((2, 3)) * observation["state"]}
"""


@contextmanager
def serving(path, log=None, key=""):
    """Serve the policy of a file with our server in a thread; yield its URL."""
    ready, opened = threading.Event(), []
    server = PolicyServer(str(path), (log if log is not None else []).append, key)

    async def run():
        def tell(port):
            opened.extend((port, asyncio.get_running_loop(), asyncio.current_task()))
            ready.set()

        with suppress(asyncio.CancelledError):
            await server.run("127.0.0.1", 0, tell)

    thread = threading.Thread(target=asyncio.run, args=[run()], daemon=True)
    thread.start()
    assert ready.wait(10)
    port, loop, task = opened
    try:
        yield f"ws://127.0.0.1:{port}"
    finally:
        loop.call_soon_threadsafe(task.cancel)
        thread.join(10)


@pytest.fixture
def policy(tmp_path):
    """Write the file of a policy; return its path."""

    def write(source=POLICY):
        path = tmp_path / "expert.py"
        path.write_text(source)
        return path

    return write


def actions(value):
    array = np.full((1, 4), value)
    data = {b"__ndarray__": True, b"data": array.tobytes(), b"dtype": array.dtype.str}
    return msgpack.packb({"actions": {**data, b"shape": array.shape}})


def after(count, last, answer):
    """Send `answer` to the first `count` observations, then `last` or what it returns."""
    left = iter(range(count))

    def react(connection, frame):
        if next(left, None) is not None:
            return answer
        return last(connection) if callable(last) else last

    return react


@contextmanager
def stock_like(answer):
    """Serve as openpi does: `answer(connection, frame)` returns the frame to send, or None."""

    def handle(connection):
        connection.send(b"\x80")  # no metadata
        for frame in connection:
            if (sent := answer(connection, frame)) is not None:
                connection.send(sent)

    with serve(handle, "127.0.0.1", 0, compression=None, max_size=None) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join(10)
