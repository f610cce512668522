"""Flood teleop's API with requests, as a separate process.

    python api_flood.py URL TOKEN SECONDS RATE

Half of the requests read with a token, a quarter has none, a quarter sends commands that are
refused. It prints the number of requests and of the answers by status, as JSON.
"""

import asyncio
import json
import sys
import time
from collections import Counter

CONNECTIONS = 64


def request(method, path, token=""):
    lines = [f"{method} {path} HTTP/1.1", "Host: x", "Content-Length: 0"]
    if token:
        lines.append(f"Authorization: Bearer {token}")
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


async def ask(address, requests, due, answers):
    """Send the requests one after the other, each when it is due [s], and read the answers."""
    reader, writer = await asyncio.open_connection(*address)
    for instant in due:
        await asyncio.sleep(instant - time.monotonic())
        answers["sent"] += 1
        writer.write(requests[answers["sent"] % len(requests)])
        head = await reader.readuntil(b"\r\n\r\n")
        await reader.readexactly(int(head.lower().partition(b"content-length: ")[2].split()[0]))
        answers[head[9:12].decode()] += 1
    writer.close()


async def flood(url, token, seconds, rate):
    host, _, port = url.removeprefix("http://").partition(":")
    look, order = request("GET", "/v1/state", token), request("POST", "/v1/resume", token)
    mixed, answers = [look, request("GET", "/v1/state"), look, order], Counter()
    began = time.monotonic()
    due = [began + number / rate for number in range(int(seconds * rate))]
    each = (due[number::CONNECTIONS] for number in range(CONNECTIONS))
    await asyncio.gather(*(ask((host, int(port)), mixed, own, answers) for own in each))
    return answers | {"seconds": time.monotonic() - began}


if __name__ == "__main__":
    url, token, seconds, rate = sys.argv[1:]
    print(json.dumps(asyncio.run(flood(url, token, float(seconds), float(rate)))))
