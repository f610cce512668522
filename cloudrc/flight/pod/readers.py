# SPDX-License-Identifier: Apache-2.0

"""Let other programs of this machine read cloud's records during a flight.

A reader has a socket in a folder, usually that of the run's sockets. Cloud sends its records to
each reader, and never waits for one: what does not fit into a reader's socket is dropped. A
datagram begins with the number of records before it, from which the reader counts the dropped ones.

Each reader connects to cloud's socket: Linux then limits the bytes that wait for the reader, a
second of records. Without a connection it limits the datagrams, usually to ten.
"""

from __future__ import annotations

import os
import select
import time
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path

from cloudrc.flight.pod.process import from_line, to_line
from cloudrc.flight.pod.teleop_link import bind_datagrams
from cloudrc.link.carry.datagrams import receive_all, send_or_lose
from cloudrc.wire.messages import Telemetry
from cloudrc.wire.pictures import Image, Jpeg
from cloudrc.wire.records import FrameKept, Record, TelemetrySent

CLOUD = "records.sock"
"""Name of cloud's socket."""
READERS = "r[0-9]*.sock"
"""Pattern of the names of the readers' sockets, which have the number of a process."""
LOOK_NS = 500_000_000
"""Time between two looks for readers [ns]."""
SIZE_MAX = 60_000
"""Size above which the records of a period are sent in several datagrams [bytes]."""
PICTURE_MAX = 40_000
"""Size of a picture above which a smaller one is sent [bytes]: in base64, it is a third larger."""
SHOWN_QUALITY = 80
"""Quality of JPEG in which pictures are sent."""
DATAGRAM_MAX = 2 * SIZE_MAX
"""Size limit of a datagram [bytes]: a single record is smaller than `SIZE_MAX`."""


class RecordSender:
    """Sends cloud's records, and the telemetry that has arrived, to all readers."""

    def __init__(self, folder: Path) -> None:
        """Send to the readers whose sockets are in `folder`."""
        self._folder, self._due_ns = folder, 0
        self._sent: dict[Path, int] = {}  # reader -> records for it so far
        self._socket = bind_datagrams(folder / CLOUD)

    def see(self, epoch: int, counter: int, telemetry: Telemetry) -> None:
        """Send telemetry that cloud uses; datagrams of it have `epoch` and `counter`."""
        self.show(TelemetrySent(telemetry.stamp_ns, epoch, counter, telemetry))

    def show(self, record: Record) -> None:
        """Send a record at once, such as one of world that cloud knows from a datagram."""
        if self._sent:
            self._send([to_line(record)])

    def show_picture(self, stamp_ns: int, image: Image) -> None:
        """Send a picture that cloud has, with the stamp of the time at which it was taken [ns].

        One that is too large for a datagram is sent with every second point, and so on.
        """
        if self._sent:
            coder = Jpeg(SHOWN_QUALITY)
            while len(data := coder.encode(image).data) > PICTURE_MAX:
                image = image[::2, ::2]
            self._send([to_line(FrameKept(stamp_ns, "jpeg", data))])

    def put(self, records: Iterable[Record]) -> None:
        """Send records, oldest first; look for new readers now and then.

        Pictures that are kept are left out: `show_picture` has sent them.
        """
        if (now_ns := time.monotonic_ns()) >= self._due_ns:
            self._due_ns = now_ns + LOOK_NS
            found = self._folder.glob(READERS)
            self._sent = {path: self._sent.get(path, 0) for path in found}
        if self._sent:
            told = (record for record in records if type(record) is not FrameKept)
            for lines in _parts(map(to_line, told)):
                self._send(lines)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def _send(self, lines: list[str]) -> None:
        body = "\n".join(lines)
        for path, before in self._sent.items():
            self._sent[path] = before + len(lines)
            send_or_lose(self._socket, f"{before}\n{body}".encode(), str(path))


class RecordReader:
    """Receives cloud's records.

    Attributes:
        dropped: Number of records that were lost because this program was too slow.
    """

    def __init__(self, folder: Path, kinds: Collection[type[Record]] = ()) -> None:
        """Begin to receive; `folder` has the sockets of cloud and its readers.

        Of the records, those of `kinds` alone are read; (): all.
        """
        self._heads = tuple(f'["{kind.__name__}"' for kind in kinds)
        # In a pod, the processes of two containers have the number 1.
        self._path = folder / f"r{os.getpid()}-{len(kinds)}.sock"
        self._cloud = str(folder / CLOUD)
        self._socket = bind_datagrams(self._path)
        self._connect()
        self._next = 0
        self.dropped = 0

    def take(self, limit: float) -> list[Record]:
        """Return the records that have arrived; if there are none, wait at most `limit` [s]."""
        if not select.select([self._socket], [], [], limit)[0]:
            self._connect()  # to a new process of cloud
        arrived = receive_all(self._socket, DATAGRAM_MAX)
        return [record for data in arrived for record in self._read(data)]

    def close(self) -> None:
        """Stop to receive."""
        self._socket.close()
        self._path.unlink(missing_ok=True)

    def _connect(self) -> None:
        self._socket.connect_ex(self._cloud)  # an error means that cloud does not run

    def _read(self, data: bytes) -> list[Record]:
        number, *lines = data.decode().split("\n")
        before = int(number)
        self.dropped += max(0, before - self._next)
        self._next = before + len(lines)  # a new process of cloud counts from 0
        return [from_line(line) for line in lines if line.startswith(self._heads or "")]


def _parts(lines: Iterable[str]) -> Iterator[list[str]]:
    """Yield the lines in groups that fit into a datagram."""
    group: list[str] = []
    size = 0
    for line in lines:
        if group and size + len(line) > SIZE_MAX:
            yield group
            group, size = [], 0
        group.append(line)
        size += len(line)
    if group:
        yield group
