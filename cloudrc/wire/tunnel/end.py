# SPDX-License-Identifier: Apache-2.0

"""The common part of both ends of the tunnel: identity, session, outgoing datagrams, records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from cloudrc.wire.messages import Command, Datagram, Fragment, Passed, RangeScan, Telemetry
from cloudrc.wire.records import Fault, FaultCode, Record
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import (
    Direction,
    encode_command,
    encode_fragment,
    encode_scan,
    encode_telemetry,
)
from cloudrc.wire.tunnel.handshake import KEY_TEXT, VERSION_TEXT
from cloudrc.wire.tunnel.keys import KeyRing
from cloudrc.wire.tunnel.session import Session
from cloudrc.wire.tunnel.window import ReceiveWindow

_ENCODERS: dict[type, Callable[[Any], bytes]] = {
    Telemetry: encode_telemetry,
    Command: encode_command,
    RangeScan: encode_scan,
    Fragment: encode_fragment,
}


@dataclass(frozen=True, slots=True)
class Identity:
    """What an end of the tunnel gets at its start: ids of its clock and its process, and keys."""

    clock_id: bytes  # 16 bytes that identify the monotonic clock of this machine
    nonce: bytes  # 16 random bytes that identify this process
    ring: KeyRing  # the pre-shared keys
    passes: bool = False  # whether telemetry and commands go to the other end as objects


class TunnelEnd:
    """The common part of world's and cloud's `Endpoint`.

    Attributes:
        counts: Name of an event -> how often the event has happened. The robot's guard or the
            control loop counts its events here, too. `count_sent` brings "sent" up to date.
    """

    def __init__(
        self, identity: Identity, sends: Direction, counts: Counter[str], *, newest_wins: bool
    ) -> None:
        self._identity, self.counts = identity, counts
        self._session = Session(sends, identity.ring)
        self._make_datagram = self._session.pass_on if identity.passes else self._encode
        self._window = ReceiveWindow(newest_wins)
        self._told: set[str] = set()  # texts of the faults in this session
        self._clock_is_shared = False
        self._datagrams: list[Datagram] = []
        self._records: list[Record] = []
        self._sent = self._sent_bytes = 0  # datagrams that `counts` lacks, and their bytes

    @property
    def epoch(self) -> int:
        """Number of the present session; 0 without a session."""
        return self._session.epoch

    def take_datagrams(self) -> list[Datagram]:
        """Return the outgoing datagrams that were made since the last call."""
        datagrams, self._datagrams = self._datagrams, []
        return datagrams

    def take_records(self) -> list[Record]:
        """Return the records made since the last call."""
        records, self._records = self._records, []
        return records

    def _tell(self, code: FaultCode, text: str, now_ns: int, trace: str = "") -> None:
        """Record a fault at `now_ns` [ns], unless this session has a fault with the same text.

        `trace` is the stack of a plug-in's failure.

        Faults with the same `code` and different texts are all recorded. A forged datagram with a
        wrong version therefore does not hide the version of the true peer.
        """
        if text not in self._told:
            self._told.add(text)
            self._records.append(Fault(now_ns, code, text, trace))

    def _tell_refusal(self, outcome: str, data: bytes, now_ns: int) -> None:
        """Record a fault at `now_ns` [ns] if `data` was refused for its version or its key.

        `outcome` is the reason of the refusal, such as "version" or "tag".
        """
        if outcome == "version":
            self._tell("version", VERSION_TEXT.format(data[0], codec.VERSION), now_ns)
        elif outcome == "tag" and codec.peek(data)[0] <= codec.LAST_HANDSHAKE:
            self._tell("key", KEY_TEXT, now_ns)

    def _send(self, kind: int, body: bytes) -> None:
        self._queue(self._session.seal(kind, body))

    def _encode(self, kind: int, message: Telemetry | Command | RangeScan | Fragment) -> bytes:
        return self._session.seal(kind, _ENCODERS[type(message)](message))

    def _queue(self, datagram: Datagram) -> None:
        self._datagrams.append(datagram)
        self._sent += 1
        self._sent_bytes += datagram.size if type(datagram) is Passed else len(datagram)

    def count_sent(self) -> None:
        """Add what was sent since the last call to `counts`; for each datagram takes longer."""
        if self._sent:
            self.counts["sent"] += self._sent
            self.counts["sent_bytes"] += self._sent_bytes
            self._sent = self._sent_bytes = 0
