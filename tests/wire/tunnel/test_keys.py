# SPDX-License-Identifier: Apache-2.0

"""Key files are parsed and written, and no text shows a key."""

import logging
import traceback

import pytest

from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet, parse, write

SECRET = bytes(range(32))
HEX, ZEROS = SECRET.hex(), bytes(32).hex()
A, B = (Key(letter * 32) for letter in (b"a", b"b"))


@pytest.mark.parametrize("size", [0, 31, 33])
def test_a_key_has_32_bytes(size):
    with pytest.raises(ValueError, match=f"32 bytes, not {size}"):
        Key(b"s" * size)


def test_texts_logs_and_tracebacks_hold_no_key(caplog):
    key = Key(SECRET)
    logging.getLogger().warning("keys: %s %r %r", key, KeyRing(KeySet(key)), [key])
    with pytest.raises(ValueError, match="neither") as error:
        parse(HEX.encode() + b"\ncurrent x")
    text = "".join(traceback.format_exception(error.value)) + caplog.text
    assert HEX[:8] not in text
    assert repr(SECRET)[2:10] not in text
    assert f"keys: <key {key.name}> " in text
    assert not hasattr(key, "__dict__")


def test_keys_are_equal_if_their_secrets_are():
    assert {Key(SECRET), Key(SECRET)} == {Key(SECRET)}
    assert A not in (B, "a" * 32)
    assert A.name != B.name


def test_a_key_file_is_read_as_it_was_written():
    for keys, accepted in ((KeySet(A), (A,)), (KeySet(A, B), (A, B))):
        assert keys.accepted == accepted
        text = write(keys)
        assert text.startswith("# A key of cloudrc's tunnel: keep it secret. Made by ")
        assert parse(text.encode()) == parse(f"\n{text}\n".encode()) == keys
    assert parse(SECRET) == KeySet(Key(SECRET))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "^expected the line 'current' and optionally 'previous', each once$"),
        (f"current {HEX}\ncurrent {HEX}", "expected the line"),
        (HEX, "^neither 32 bytes nor lines of 'name value'$"),
        ("\xff" * 40, "neither 32 bytes nor lines"),
        (f"current {HEX[:-2]}", "^a key has 64 hexadecimal digits$"),
        (f"current {HEX}\nprevious {'zz' * 32}", "^a key has 64 hexadecimal digits$"),
        (f"current {ZEROS}", "^an all-zero key is refused: everybody knows it$"),
    ],
)
def test_an_invalid_key_file_is_refused(text, said):
    with pytest.raises(ValueError, match=said) as error:
        parse(text.encode("latin-1"))
    assert HEX[:8] not in str(error.value)
