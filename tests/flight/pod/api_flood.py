# SPDX-License-Identifier: Apache-2.0

"""Flood teleop's API with requests for a second, as a separate process.

    python api_flood.py URL TOKEN RATE

Half of the requests read with a token, a quarter has none, a quarter sends commands that are
refused. Each request is sent when it is due, even if earlier ones have no answer yet. It prints the
how long it sent them [s], and the number of answers by status, as JSON. RATE is a multiple of 50.
"""

import asyncio
import json
import sys
import time
from collections import Counter

CONNECTIONS = 50


def request(method, path, token=""):
    lines = [f"{method} {path} HTTP/1.1", "Host: x", "Content-Length: 0"]
    if token:
        lines.append(f"Authorization: Bearer {token}")
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


async def receive(reader, count, found):
    """Read `count` answers."""
    for _ in range(count):
        head = await reader.readuntil(b"\r\n\r\n")
        await reader.readexactly(int(head.lower().partition(b"content-length: ")[2].split()[0]))
        found[head[9:12].decode()] += 1


async def flood(url, token, rate):
    host, _, port = url.removeprefix("http://").partition(":")
    look, order = request("GET", "/v1/state", token), request("POST", "/v1/resume", token)
    mixed, found = [look, request("GET", "/v1/state"), look, order], Counter()
    opened = [await asyncio.open_connection(host, int(port)) for _ in range(CONNECTIONS)]
    count = rate // CONNECTIONS
    answers = [asyncio.create_task(receive(reader, count, found)) for reader, _ in opened]
    began = time.monotonic()
    for number in range(rate):
        await asyncio.sleep(began + number / rate - time.monotonic())
        opened[number % CONNECTIONS][1].write(mixed[number // CONNECTIONS % len(mixed)])
    took = time.monotonic() - began
    await asyncio.gather(*answers)
    for _, writer in opened:
        writer.close()
    return found | {"seconds": took, "answered": time.monotonic() - began}


if __name__ == "__main__":
    url, token, rate = sys.argv[1:]
    print(json.dumps(asyncio.run(flood(url, token, int(rate)))))
