"""Flood teleop's API with requests and slow clients, as a separate process.

    python api_flood.py URL TOKEN SECONDS RATE

Half of the requests read with a token, a quarter has none, a quarter sends rejected commands. It
prints the number of requests and of the answers by status, as JSON.
"""

import json
import selectors
import socket
import sys
import time
from collections import Counter

CONNECTIONS = 16
DAWDLERS = 50


def request(method, path, token, body=b""):
    lines = [f"{method} {path} HTTP/1.1", "Host: x", f"Content-Length: {len(body)}"]
    if token:
        lines.append(f"Authorization: Bearer {token}")
    return ("\r\n".join(lines) + "\r\n\r\n").encode() + body


class Flood:
    """Open connections that send in turns without waiting for answers."""

    def __init__(self, address, token):
        self.address, self.asked, self.sent, self.answers = address, 0, 0, Counter()
        self.selector = selectors.DefaultSelector()
        look, none = request("GET", "/v1/state", token), request("GET", "/v1/state", "")
        self.requests = [look, none, look, request("POST", "/v1/resume", token)]
        self.free = {self.connect() for _ in range(CONNECTIONS)}
        self.dawdlers = [socket.create_connection(address) for _ in range(DAWDLERS)]

    def connect(self):
        connection = socket.create_connection(self.address, timeout=1.0)
        self.selector.register(connection, selectors.EVENT_READ)
        return connection

    def ask(self):
        self.asked += 1
        try:
            connection = self.free.pop() if self.free else self.connect()
        except OSError:
            self.answers["no connection"] += 1
            return
        try:
            connection.sendall(self.requests[self.asked % len(self.requests)])
        except OSError:
            self.forget(connection)
            return
        self.sent += 1

    def listen(self, wait):
        for key, _ in self.selector.select(wait):
            connection = key.fileobj
            try:
                data = connection.recv(65_536)
            except OSError:
                data = b""
            if not data:
                self.forget(connection)
                continue
            if data.startswith(b"HTTP/1.1 "):
                self.answers[data[9:12].decode()] += 1
                self.free.add(connection)

    def forget(self, connection):
        self.free.discard(connection)
        self.selector.unregister(connection)
        connection.close()
        self.answers["closed"] += 1

    def dawdle(self):
        """Send a byte on each; reopen closed connections."""
        for number, dawdler in enumerate(self.dawdlers):
            try:
                dawdler.sendall(b"G")
            except OSError:
                dawdler.close()
                self.answers["cut off"] += 1
                self.dawdlers[number] = socket.create_connection(self.address, timeout=5.0)


def main():
    url, token, seconds, rate = sys.argv[1], sys.argv[2], float(sys.argv[3]), float(sys.argv[4])
    host, _, port = url.removeprefix("http://").partition(":")
    flood = Flood((host, int(port)), token)
    began = dawdled = time.monotonic()
    while (now := time.monotonic()) - began < seconds:
        for _ in range(min(50, int((now - began) * rate) - flood.asked)):
            flood.ask()
        flood.listen(0.002)
        if now - dawdled > 0.5:
            dawdled = now
            flood.dawdle()
    flood.listen(0.2)
    print(json.dumps({"sent": flood.sent, "seconds": seconds, **flood.answers}))


if __name__ == "__main__":
    main()
