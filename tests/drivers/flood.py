"""Flood teleop's API with requests, or world's port with garbage, as a separate process.

    python flood.py requests URL TOKEN SECONDS RATE
    python flood.py garbage HOST:PORT SECONDS RATE

Half of the requests read with a token, a quarter has none, a quarter sends commands that are
refused. It prints what it sent, and the number of answers by status, as JSON.
"""

import asyncio
import json
import random
import socket
import struct
import sys
import time
from collections import Counter

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Kind

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


async def requests(url, token, seconds, rate):
    host, _, port = url.removeprefix("http://").partition(":")
    look, order = request("GET", "/v1/state", token), request("POST", "/v1/resume", token)
    mixed, answers = [look, request("GET", "/v1/state"), look, order], Counter()
    began = time.monotonic()
    due = [began + number / rate for number in range(int(seconds * rate))]
    each = (due[number::CONNECTIONS] for number in range(CONNECTIONS))
    await asyncio.gather(*(ask((host, int(port)), mixed, own, answers) for own in each))
    return answers | {"seconds": time.monotonic() - began}


async def garbage(address, seconds, rate):
    """Send noise, headers with a wrong length, and right lengths with a wrong tag."""
    rng, made, sent, began = random.Random(1), [], 0, time.monotonic()
    for number in range(5000):
        size = codec.BODY_SIZES[Kind.COMMAND] + codec.TAG_SIZE + number % 3 - 2
        header = struct.pack("<BBIxBQ", codec.VERSION, 1, rng.choice((1, 2)), Kind.COMMAND, number)
        noise = rng.randbytes(rng.choice((0, 1, 15, 16, 64, 300, 1400)))
        made.append(header + rng.randbytes(size) if number % 3 else noise)
    host, _, port = address.partition(":")
    with socket.socket(type=socket.SOCK_DGRAM) as udp:
        while (passed := time.monotonic() - began) < seconds:
            while sent < passed * rate:
                udp.sendto(made[sent % len(made)], (host, int(port)))
                sent += 1
            time.sleep(0.001)  # bursts of one millisecond
    return {"sent": sent}


if __name__ == "__main__":
    kind, *words, seconds, rate = sys.argv[1:]
    flood = {"requests": requests, "garbage": garbage}[kind]
    print(json.dumps(asyncio.run(flood(*words, float(seconds), float(rate)))))
