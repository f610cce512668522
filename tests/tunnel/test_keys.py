"""Keys: what a file may hold, and that a key is never shown."""

from __future__ import annotations

import copy
import logging
import traceback
from collections.abc import Callable

import pytest

from cloudrc.tunnel.keys import Key, KeyRing, KeySet, parse, write

SECRET = bytes(range(32))
HEX, ZEROS = SECRET.hex(), bytes(32).hex()
A, B = (Key(letter * 32) for letter in (b"a", b"b"))


@pytest.mark.parametrize("size", [0, 31, 33, 64])
def test_a_key_has_32_bytes(size: int) -> None:
    with pytest.raises(ValueError, match=f"32 bytes, not {size}"):
        Key(b"s" * size)


@pytest.mark.parametrize(
    "show",
    [repr, str, "{}".format, lambda key: repr(KeySet(key)), lambda key: repr([key])],
)
def test_the_text_of_a_key_does_not_show_the_key(show: Callable[[Key], str]) -> None:
    text = show(Key(SECRET))
    assert HEX[:8] not in text
    assert repr(SECRET)[2:10] not in text


def test_a_key_is_not_pickled_and_not_copied() -> None:
    for spread in (copy.copy, copy.deepcopy, lambda key: key.__reduce_ex__(4)):
        with pytest.raises(TypeError, match=r"^a key is not pickled$"):
            spread(Key(SECRET))


def test_a_log_and_a_traceback_hold_no_key(caplog: pytest.LogCaptureFixture) -> None:
    logging.getLogger().warning("keys: %s %r", Key(SECRET), KeyRing(KeySet(Key(SECRET))))
    try:
        parse(HEX.encode() + b"\ncurrent x")
    except ValueError as error:
        text = "".join(traceback.format_exception(error)) + caplog.text
    assert HEX[:16] not in text


def test_keys_are_equal_by_what_they_hold() -> None:
    assert Key(SECRET) == Key(SECRET)
    assert hash(Key(SECRET)) == hash(Key(SECRET))
    assert A not in (B, "a" * 32)
    assert A.name != B.name
    assert hash(A) != hash(B)


@pytest.mark.parametrize(("keys", "accepted"), [(KeySet(A), (A,)), (KeySet(A, B), (A, B))])
def test_a_written_key_file_parses_to_the_same_keys(keys: KeySet, accepted: tuple[Key]) -> None:
    assert write(keys).startswith("# A key of cloudrc's tunnel: keep it secret. Made by ")
    assert parse(write(keys).encode()) == keys
    assert keys.accepted == accepted


def test_a_file_of_32_bytes_is_a_key() -> None:
    assert parse(SECRET) == KeySet(Key(SECRET))


def test_the_times_of_an_older_file_are_ignored() -> None:
    text = write(KeySet(A, B)) + "overlap_s 300\nprevious_until_s 1795000300\n"
    assert parse(text.encode()) == KeySet(A, B)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "^expected the line 'current' and optionally 'previous', each once$"),
        ("# only a comment", "expected the line"),
        (f"previous {HEX}", "expected the line"),
        (f"current {HEX}\nnext {HEX}", "expected the line"),
        (f"current {HEX}\ncurrent {HEX}", "expected the line"),
        (HEX, "neither 32 bytes nor lines"),
        (f"current {HEX} {HEX}", "neither 32 bytes nor lines"),
        ("\xff" * 40, "neither 32 bytes nor lines"),
        (f"current {HEX[:-2]}", "64 hexadecimal digits"),
        (f"current {HEX[:-1]}x", "64 hexadecimal digits"),
        (f"current {HEX}\nprevious x", "64 hexadecimal digits"),
        ("\0" * 32, "^an all-zero key is refused: everybody knows it$"),
        (f"current {ZEROS}", "an all-zero key is refused"),
        (f"current {HEX}\nprevious {ZEROS}", "an all-zero key is refused"),
    ],
)
def test_the_error_of_a_wrong_file_does_not_show_the_key(text: str, said: str) -> None:
    with pytest.raises(ValueError, match=said) as caught:
        parse(text.encode("latin-1"))
    assert HEX[:8] not in str(caught.value)
    assert caught.value.__suppress_context__ or caught.value.__context__ is None
