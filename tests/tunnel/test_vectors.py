"""Known answers: the primitives as their standards have them, our datagrams as they stay.

The datagrams are also made here from the design's words alone, by other means than the tunnel's.
"""

import hashlib
import hmac
import struct
from types import SimpleNamespace

import pytest
from cryptography.exceptions import InvalidTag
from cryptography.hazmat.primitives.ciphers.aead import AESGCM, ChaCha20Poly1305
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.kdf.hkdf import HKDF

from cloudrc.messages import Command
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Busy, Direction, Hello, Kind
from cloudrc.tunnel.handshake import ClientHandshake, ServerHandshake
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import AES_256_GCM, CHACHA20_POLY1305, REKEY_NS, Session, pair

SECRET = bytes(range(32))
BODY = codec.encode_command(Command(1, 2, 3, (4.0, 5.0, 6.0), 7.0))

# RFC 5869, appendix A, test cases 1 to 3: key, salt, info, length, result.
HKDF_VECTORS = [
    (
        "0b" * 22,
        "000102030405060708090a0b0c",
        "f0f1f2f3f4f5f6f7f8f9",
        42,
        "3cb25f25faacd57a90434f64d0362f2a2d2d0a90cf1a5a4c5db02d56ecc4c5bf34007208d5b887185865",
    ),
    (
        bytes(range(0x00, 0x50)).hex(),
        bytes(range(0x60, 0xB0)).hex(),
        bytes(range(0xB0, 0x100)).hex(),
        82,
        "b11e398dc80327a1c8e7f78c596a49344f012eda2d4efad8a050cc4c19afa97c59045a99cac7827271cb41c6"
        "5e590e09da3275600c2f09b8367793a9aca3db71cc30c58179ec3e87c14c01d5c1f3434f1d87",
    ),
    (
        "0b" * 22,
        "",
        "",
        42,
        "8da4e775a563c18f715f802a063c5a31b8a11f5c5ee1879ec3454e5f3c738d2d9d201395faa4b61a96c8",
    ),
]


def derived(key, salt, info, length=32):
    """Compute HKDF-SHA256 by hand: extract, expand."""
    inner = hmac.digest(salt or bytes(32), key, hashlib.sha256)
    block, out = b"", b""
    for number in range(1, -(-length // 32) + 1):
        block = hmac.digest(inner, block + info + bytes([number]), hashlib.sha256)
        out += block
    return out[:length]


@pytest.mark.parametrize(("key", "salt", "info", "length", "result"), HKDF_VECTORS)
def test_hkdf_is_that_of_rfc_5869(key, salt, info, length, result):
    key, salt, info = map(bytes.fromhex, (key, salt, info))
    assert HKDF(SHA256(), length, salt, info).derive(key).hex() == result
    assert derived(key, salt, info, length).hex() == result


def test_a_key_derives_by_hkdf_with_version_and_use():
    label = b"cloudrc 5 use"
    assert Key(SECRET).derive(b"salt", b"use") == derived(SECRET, b"salt", label)


def test_the_name_of_a_key_is_derived_from_it():
    assert Key(SECRET).name == derived(SECRET, b"", b"cloudrc 5 name")[:4].hex()


# McGrew and Viega, "The Galois/Counter Mode of Operation", submitted to NIST: test case 16.
GCM_KEY = "feffe9928665731c6d6a8f9467308308" * 2
GCM_NONCE = "cafebabefacedbaddecaf888"
GCM_TEXT = (
    "d9313225f88406e5a55909c5aff5269a86a7a9531534f7da2e4c303d8a318a72"
    "1c3c0c95956809532fcf0e2449a6b525b16aedf5aa0de657ba637b39"
)
GCM_HEADER = "feedfacedeadbeeffeedfacedeadbeefabaddad2"
GCM_SEALED = (
    "522dc1f099567d07f47f37a32a84427d643a8cdcbfe5c0c97598a2bd2555d1aa"
    "8cb08e48590dbb3da7b08b1056828838c5f61e6393ba7a0abcc9f662"
    "76fc6ece0f4e1768cddf8853bb2d551b"
)


def test_gcm_is_that_of_nist():
    cipher = AESGCM(bytes.fromhex(GCM_KEY))
    nonce, text, header = map(bytes.fromhex, (GCM_NONCE, GCM_TEXT, GCM_HEADER))
    assert cipher.encrypt(nonce, text, header).hex() == GCM_SEALED
    assert cipher.decrypt(nonce, bytes.fromhex(GCM_SEALED), header) == text
    with pytest.raises(InvalidTag):
        cipher.decrypt(nonce, bytes.fromhex(GCM_SEALED), header[:-1])


# RFC 8439, section 2.8.2.
CHACHA_KEY = bytes(range(0x80, 0xA0))
CHACHA_NONCE = "070000004041424344454647"
CHACHA_HEADER = "50515253c0c1c2c3c4c5c6c7"
CHACHA_TEXT = (
    b"Ladies and Gentlemen of the class of '99: If I could offer you only one tip for the future,"
    b" sunscreen would be it."
)
CHACHA_SEALED = (
    "d31a8d34648e60db7b86afbc53ef7ec2a4aded51296e08fea9e2b5a736ee62d6"
    "3dbea45e8ca9671282fafb69da92728b1a71de0a9e060b2905d6a5b67ecd3b36"
    "92ddbd7f2d778b8c9803aee328091b58fab324e4fad675945585808b4831d7bc"
    "3ff4def08e4b7a9de576d26586cec64b61161ae10b594f09e26a7e902ecbd0600691"
)


def test_chacha20_poly1305_is_that_of_rfc_8439():
    cipher = ChaCha20Poly1305(CHACHA_KEY)
    nonce, header = map(bytes.fromhex, (CHACHA_NONCE, CHACHA_HEADER))
    assert cipher.encrypt(nonce, CHACHA_TEXT, header).hex() == CHACHA_SEALED


def by_hand(suite, direction, epoch, generation, kind, counter, body):
    """Make a sealed datagram as docs/wire.md describes it."""
    use = b"cloudrc 5 session %d %d %d %d" % (suite, direction, epoch, generation)
    key = derived(SECRET, b"cloud".ljust(16) + b"world".ljust(16), use)
    header = struct.pack("<BBIBBQ", 5, direction, epoch, generation % 256, kind, counter)
    cipher = AESGCM(key) if suite == 1 else ChaCha20Poly1305(key)
    return header + cipher.encrypt(header[4:], body, header)


@pytest.mark.parametrize("suite", [AES_256_GCM, CHACHA20_POLY1305])
def test_a_datagram_can_be_made_from_the_description_alone(suite):
    world, cloud = pair(0x01020304, SECRET, suite)
    cloud.seal(Kind.COMMAND, BODY)
    sealed = cloud.seal(Kind.COMMAND, BODY)
    assert sealed == by_hand(suite, 1, 0x01020304, 0, 6, 1, BODY)
    world.maintain(0)
    world.maintain(REKEY_NS)
    assert world.seal(Kind.ALIVE, b"") == by_hand(suite, 0, 0x01020304, 1, 8, 0, b"")


def test_a_greeting_can_be_made_from_the_description_alone():
    session = Session(Direction.DOWNLINK, KeyRing(KeySet(Key(SECRET))))
    body = codec.encode_hello(Hello(b"n" * 16, b"c" * 16, b"k" * 16, 1))
    data = struct.pack("<BBIBBQ", 5, 1, 0, 0, 1, 0) + body
    tagging = derived(SECRET, b"", b"cloudrc 5 greeting")
    tag = hmac.digest(tagging, data, hashlib.sha256)[:16]
    assert session.greet(Kind.HELLO, body) == data + tag


def test_a_cookie_can_be_made_from_the_description_alone():
    identity = SimpleNamespace(
        nonce=b"w" * 16, clock_id=bytes(16), suite=1, last_epoch=0, next_epoch=None
    )
    door = ServerHandshake(
        Session(Direction.UPLINK, KeyRing(KeySet(Key(SECRET)))), identity, age_max_ns=1
    )
    cookies = derived(SECRET, b"w" * 16, b"cloudrc 5 cookies")
    (answer,) = door.receive_hello(
        Hello(bytes(16), bytes(16), bytes(16), 1), 0, 7_999_999_999
    ).datagrams
    cookie = hmac.digest(cookies, b"3", hashlib.sha256)[:16]
    assert answer[16:-16] == cookie + bytes(33)


def test_a_clouds_next_nonce_is_derived_from_the_first():
    handshake = ClientHandshake(b"n" * 16, bytes(16), 1)
    handshake.receive_busy(Busy(b"n" * 16, used=True))
    second = hashlib.sha256(b"n" * 16 + b" 1").digest()[:16]
    assert codec.decode_hello(handshake.make_hello()).nonce == second
    handshake.receive_busy(Busy(second, used=True))
    third = hashlib.sha256(b"n" * 16 + b" 2").digest()[:16]
    assert codec.decode_hello(handshake.make_hello()).nonce == third


FROZEN = {
    (AES_256_GCM, Kind.COMMAND): (
        "050107000000000600000000000000004849753119341adf51181dd39732a02320d0f5b4cd45d4a3"
        "a44073943e4e1fc1c4bdc60728769976d6fefca1012f98d72245370c30d40778fd83747d7f8ced23"
        "4cde87d757611564"
    ),
    (AES_256_GCM, Kind.ALIVE): ("050107000000000800000000000000005be2b6966721a6b47c110d8a57e3cdb7"),
    (CHACHA20_POLY1305, Kind.COMMAND): (
        "050107000000000600000000000000003d4af1049ea1addf07d11e3ebcb34e5f9afc50b17bacf3ce"
        "071100c0e3f9fcc99fdaf305afc7aa18c94def68273541297c64fa70e36888cbbd416e18c4483ed7"
        "7f1a9d40c4747fe0"
    ),
    (CHACHA20_POLY1305, Kind.ALIVE): (
        "050107000000000800000000000000005adf6fc11e2258aa23ce1349f9620714"
    ),
}


@pytest.mark.parametrize(("suite", "kind"), FROZEN)
def test_the_wire_stays_as_it_is(suite, kind):
    """If this changes, the wire format changes: raise codec.VERSION, too."""
    world, cloud = pair(7, SECRET, suite)
    end = world if kind == Kind.TELEMETRY else cloud
    body = bytes(n % 251 for n in range(codec.BODY_SIZES[kind]))
    assert end.seal(kind, body).hex() == FROZEN[suite, kind]
