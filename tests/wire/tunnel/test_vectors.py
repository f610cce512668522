# SPDX-License-Identifier: Apache-2.0

"""Datagrams have fixed bytes, and agree with docs/wire.md."""

import hashlib
import hmac
import struct

from cryptography.hazmat.primitives.ciphers.aead import AESGCM

from cloudrc.wire.messages import Command, Fragment, RangeScan
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Direction, Kind
from cloudrc.wire.tunnel.handshake import ClientHandshake, ServerHandshake
from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.wire.tunnel.session import Session

SECRET = bytes(range(32))
CLOUD, WORLD, CLOCK = b"cloud".ljust(16), b"world".ljust(16), b"clock".ljust(16)


def derived(salt, info):
    """Compute the 32 bytes of HKDF-SHA256 by hand: extract, expand."""
    inner = hmac.digest(salt or bytes(32), SECRET, hashlib.sha256)
    return hmac.digest(inner, info + b"\1", hashlib.sha256)


GOLDEN = {
    "accept": (
        "08000700000000020000000000000000636c6f75642020202020202020202020776f726c642020202020"
        "202020202020636c6f636b202020202020202020202000fd1475d23fc8628223530f1ba86724da"
    ),
    "command": (
        "08010700000000060100000000000000ec2ab33bfdac561646213f3a4a70240460d0a3f2c6de0ab698e7"
        "503d6d169816a85ac1663bcad6bcf60e132101233551653ade585bf42fb7e14cb33e87893cce13f4603d"
        "f2d9d8f9"
    ),
}
"""Bytes of datagrams. If they change, the format has changed: raise `codec.VERSION`."""


def handshake(direction, epoch, kind, counter, body):
    """Make a message of the handshake as docs/wire.md describes it."""
    data = struct.pack("<BBIBBQ", 8, direction, epoch, 0, kind, counter) + body
    return data + hmac.digest(derived(b"", b"cloudrc 8 greeting"), data, hashlib.sha256)[:16]


def sealed(direction, epoch, kind, counter, body):
    """Make a datagram of a session as docs/wire.md describes it."""
    key = derived(CLOUD + WORLD, b"cloudrc 8 session %d %d" % (direction, epoch))
    header = struct.pack("<BBIBBQ", 8, direction, epoch, 0, kind, counter)
    return header + AESGCM(key).encrypt(header[4:], body, header)


def test_the_tunnel_is_as_described_and_as_it_was():
    world, cloud = (Session(way, KeyRing(KeySet(Key(SECRET)))) for way in Direction)
    server, client = ServerHandshake(world, WORLD, CLOCK, 1), ClientHandshake(CLOUD, CLOCK)
    server._epoch = 6

    def answer(hello):
        _, _, counter, body = world.open(hello)
        told = server.receive_hello(
            codec.Hello(*codec.decode(Kind.HELLO, body)), counter, 7_999_999_999
        )
        return told.datagrams[0]

    cookie = hmac.digest(derived(WORLD, b"cloudrc 8 cookies"), b"3", hashlib.sha256)[:13]
    first = cloud.sign(Kind.HELLO, client.make_hello())
    challenge = answer(first)
    assert codec.decode(Kind.CHALLENGE, cloud.open(challenge)[-1])[0] == cookie
    second = cloud.sign(Kind.HELLO, client.answer_challenge(cookie) or b"")
    accept = answer(second)
    stranger = codec.Hello(b"m" * 16, CLOCK, cookie, 0)
    busy = answer(cloud.sign(Kind.HELLO, codec.encode(Kind.HELLO, *stranger)))
    hello, told = CLOUD + CLOCK, struct.pack("<I", 0)
    assert [first, challenge, second, accept, busy] == [
        handshake(1, 0, 1, 0, hello + bytes(13) + told),
        handshake(0, 0, 3, 0, cookie + bytes(36)),
        handshake(1, 0, 1, 1, hello + cookie + told),
        handshake(0, 7, 2, 0, CLOUD + WORLD + CLOCK + b"\0"),
        handshake(0, 0, 4, 0, b"m" * 16 + b"\0"),
    ]

    _, epoch, _, body = cloud.open(accept)
    nonces = client.receive_accept(epoch, codec.Accept(*codec.decode(Kind.ACCEPT, body)), asks=True)
    assert nonces is not None
    cloud.begin(epoch, nonces)
    body = codec.encode_command(Command(1, 2, 3, (4.0, 5.0, 6.0), 7.0))
    assert body == struct.pack("<qqqdddd", 1, 2, 3, 4.0, 5.0, 6.0, 7.0)
    plan = Command(1, 2, 3, (4.0, 5.0, 6.0), 7.0, ((1.0, 2.0, 3.0), (4.0, 5.0, 6.5)), 8)
    more = struct.pack("<q6f", 8, 1.0, 2.0, 3.0, 4.0, 5.0, 6.5)
    assert codec.encode_command(plan) == body + more
    scan = codec.encode_scan(RangeScan(1, (0, 2, 65535)))
    assert scan == struct.pack("<qHHH", 1, 0, 2, 65535)
    cloud.seal(Kind.COMMAND, body)
    command, alive = cloud.seal(Kind.COMMAND, body), world.seal(Kind.ALIVE, b"")
    assert [command, alive] == [sealed(1, 7, 6, 1, body), sealed(0, 7, 8, 0, b"")]
    assert {"accept": accept.hex(), "command": command.hex()} == GOLDEN
    assert world.open(command) == (6, 7, 1, body)
    assert cloud.open(alive) == (8, 7, 0, b"")
    sent = world.seal(Kind.SCAN, scan)
    assert sent == sealed(0, 7, 9, 0, scan)
    assert cloud.open(sent) == (9, 7, 0, scan)
    assert codec.decode_scan(scan) == RangeScan(1, (0, 2, 65535))
    assert len(world.seal(Kind.SCAN, codec.encode_scan(RangeScan(1, (0,) * 181)))) == 402
    fragment = Fragment(1, 2, 3, 4, True, bytes(1151))
    body = codec.encode_fragment(fragment)
    assert body == struct.pack("<qIHHB", 1, 2, 3, 4, 1) + bytes(1151)
    sent = world.seal(Kind.FRAME, body)
    assert sent == sealed(0, 7, 10, 0, body)
    assert len(sent) == 1200
    assert codec.decode_fragment(cloud.open(sent)[3]) == fragment


def test_names_and_nonces_are_derived_as_described():
    assert Key(SECRET).name == derived(b"", b"cloudrc 8 name")[:4].hex()
    client = ClientHandshake(CLOUD, CLOCK)
    for world in (b"1" * 16, b"2" * 16, b"1" * 16):  # the first one comes back
        client.receive_accept(1, codec.Accept(CLOUD, world, CLOCK), asks=True)
    nonce = codec.Hello(*codec.decode(Kind.HELLO, client.make_hello())).nonce
    assert nonce == hashlib.sha256(CLOUD + b" 1").digest()[:16]
