"""Who cloud's end is, and which keys it has."""

from __future__ import annotations

from dataclasses import dataclass

from cloudrc.tunnel.keys import KeyRing
from cloudrc.tunnel.session import AES_256_GCM


@dataclass(frozen=True, slots=True)
class CloudIdentity:
    """What cloud's end is given at its start.

    Attributes:
        clock_id: 16 bytes that name this machine's monotonic clock.
        nonce: 16 bytes that name this process; never the same twice.
        ring: The pre-shared keys; None for an end that never leaves its process.
        suite: Cipher that this machine is fast at.
    """

    clock_id: bytes
    nonce: bytes
    ring: KeyRing | None = None
    suite: int = AES_256_GCM
