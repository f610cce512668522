"""Who world's end is, what it must not forget, and what it may accept."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from cloudrc.tunnel.keys import KeyRing
from cloudrc.tunnel.session import AES_256_GCM


@dataclass(frozen=True, slots=True)
class WorldIdentity:
    """What world's end is given at its start.

    Attributes:
        clock_id: 16 bytes that name this machine's monotonic clock.
        nonce: 16 bytes that name this process; never the same twice.
        last_epoch: The last epoch handed out before this process began.
        ring: The pre-shared keys; None for an end that never leaves its process.
        suite: Cipher that this machine is fast at.
        next_epoch: Gives epochs that are persisted before they are used, or None as long as the
            disk has none; None to count on from `last_epoch`.
    """

    clock_id: bytes
    nonce: bytes
    last_epoch: int = 0
    ring: KeyRing | None = None
    suite: int = AES_256_GCM
    next_epoch: Callable[[], int | None] | None = None
