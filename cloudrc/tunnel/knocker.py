"""Greetings, cloud's side: what its hellos say, and which answers count.

World's side, and what goes over the wire, is in `cloudrc.tunnel.handshake`.
"""

from __future__ import annotations

import hashlib
from collections import deque

from cloudrc.tunnel.codec import Accept, Busy, Hello, encode_hello
from cloudrc.tunnel.session import Agreement

NO_COOKIE = bytes(16)
REPLIES_MAX = 3
"""Challenges that cloud answers at once, between two hellos of its own accord."""
COOKIES_MAX = 4096
"""Cookies that cloud remembers: over two hours of world's, a slot each."""
EPOCHS = 2**32
"""An epoch that is less than half of them ahead is newer; after the last one comes 1."""
LEFT_MAX = 64
"""Earlier world processes remembered."""


class Knocker:
    """Cloud's side: what its hellos say, and which answers count."""

    def __init__(self, nonce: bytes, clock: bytes, suite: int) -> None:
        """Begin without a session.

        Args:
            nonce: 16 bytes that name this process; new ones at every start.
            clock: 16 bytes that name its monotonic clock.
            suite: Cipher that cloud would like.
        """
        self._seed, self._clock, self._suite = nonce, clock, suite
        self._nonce, self._nonces = nonce, 0
        self._cookie = NO_COOKIE
        self._replies = 0
        self._cookies: dict[bytes, None] = {}  # that have come, in their order
        self._world = b""
        self._left: deque[bytes] = deque(maxlen=LEFT_MAX)

    def hello(self) -> bytes:
        """The body of a hello of cloud's own accord."""
        self._replies = REPLIES_MAX
        return self._hello()

    def challenged(self, cookie: bytes) -> bytes | None:
        """Take a challenge; the body of the hello that answers it, or None if it needs none.

        A cookie that has come before is left alone: it is in the next hello if it is the newest,
        and an old one that somebody repeats must not take the place of that.
        """
        if self._replies == 0 or cookie in self._cookies:
            return None
        self._replies -= 1
        self._cookie = cookie
        self._cookies[cookie] = None
        if len(self._cookies) > COOKIES_MAX:
            del self._cookies[next(iter(self._cookies))]
        return self._hello()

    def refused(self, busy: Busy) -> bool:
        """Take a refusal; whether it is one of what cloud asks for, by another's authority."""
        if busy.nonce != self._nonce:
            return False
        if busy.used:  # ours, but lost to another cloud meanwhile
            self._rename()
        return not busy.used

    def accepted(self, epoch: int, accept: Accept, current: int, *, asks: bool) -> Agreement | None:
        """Take an acceptance.

        Another world is taken while cloud asks only: what a process that is gone has sent may come
        late. Was it taken all the same, the one that lives is among those left: it answers what
        cloud goes on asking, and is asked under another name.

        Args:
            epoch: From its header.
            accept: Its body.
            current: Epoch of the session until now.
            asks: Whether cloud wants a session: it has none, or does not hear world in it.

        Returns:
            What the session under the new epoch rests on; None if this is not for us, or old.
        """
        known = accept.world_nonce == self._world
        if accept.nonce != self._nonce or (self._world and not known and not asks):
            return None
        if accept.world_nonce in self._left:
            self._rename()
            return None
        if known:
            if not 0 < (epoch - current) % EPOCHS < EPOCHS // 2:
                return None
        elif self._world:
            self._left.append(self._world)  # a process that is gone does not come back
        self._world = accept.world_nonce
        return Agreement(accept.nonce, accept.world_nonce, accept.suite)

    def _rename(self) -> None:
        """Ask under another name, of which nothing has been captured."""
        self._nonces += 1
        text = b"%s %d" % (self._seed, self._nonces)
        self._nonce = hashlib.sha256(text).digest()[:16]
        self._left.clear()

    def _hello(self) -> bytes:
        return encode_hello(Hello(self._nonce, self._clock, self._cookie, self._suite))
