"""Keys: read, rotated, and never shown."""

import copy
import logging
import traceback

import pytest

from cloudrc.tunnel.keys import OVERLAP, Key, KeyRing, KeySet, parse, write

SECRET = bytes(range(32))
A, B, C = (Key(letter * 32) for letter in (b"a", b"b", b"c"))
SECOND_NS = 1_000_000_000
MADE = 1_795_000_000.0  # when a key file was made [s since 1970]
ROTATED = KeySet(B, A, 300.0, MADE + 300.0)


@pytest.mark.parametrize("size", [0, 31, 33, 64])
def test_a_key_has_32_bytes(size):
    with pytest.raises(ValueError, match=f"32 bytes, not {size}"):
        Key(b"s" * size)


@pytest.mark.parametrize(
    "show",
    [repr, str, "{}".format, "{!r}".format, lambda key: repr(KeySet(key)), lambda k: repr([k])],
)
def test_the_text_of_a_key_does_not_show_the_key(show):
    text = show(Key(SECRET))
    assert SECRET.hex()[:8] not in text
    assert repr(SECRET)[2:10] not in text


def test_a_key_is_not_pickled_and_not_copied():
    for spread in (copy.copy, copy.deepcopy, lambda key: key.__reduce_ex__(4)):
        with pytest.raises(TypeError, match=r"^a key is not pickled$"):
            spread(Key(SECRET))


def test_a_log_and_a_traceback_hold_no_key(caplog):
    logging.getLogger().warning("keys: %s %r", Key(SECRET), KeyRing(KeySet(Key(SECRET))))
    try:
        parse(SECRET.hex().encode() + b"\ncurrent x")
    except ValueError as error:
        text = "".join(traceback.format_exception(error)) + caplog.text
    assert SECRET.hex()[:16] not in text


def test_keys_are_equal_by_what_they_hold():
    assert Key(SECRET) == Key(SECRET)
    assert hash(Key(SECRET)) == hash(Key(SECRET))
    assert A != B
    assert A != "a" * 32
    assert A.name != B.name
    assert hash(A) != hash(B)


def test_a_tag_fits_only_its_key_and_its_data():
    tag = A.tag(b"data")
    assert len(tag) == 16
    assert A.verifies(b"data", tag)
    assert not A.verifies(b"date", tag)
    assert not B.verifies(b"data", tag)


def test_a_derived_key_depends_on_salt_and_use():
    derived = {A.derive(salt, use) for salt in (b"", b"s") for use in (b"u", b"v")}
    assert len(derived) == 4


@pytest.mark.parametrize(
    "keys",
    [
        *(KeySet(A), KeySet(A, B, 60.0), KeySet(A, B, 0.5), KeySet(A, B, 86_400.0), ROTATED),
        *(ROTATED._replace(until=until) for until in (0.0, 253_402_300_799.0)),
    ],
)
def test_a_written_key_file_parses_to_the_same_keys(keys):
    assert parse(write(keys).encode()) == keys


def test_a_key_file_explains_itself():
    assert write(KeySet(A)).startswith(
        "# A key of cloudrc's tunnel: keep it secret. Made by 'cloudrc key new'.\ncurrent "
    )


def test_a_file_of_32_bytes_is_a_key():
    assert parse(SECRET) == KeySet(Key(SECRET), None, OVERLAP)


HEX = SECRET.hex()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "",
            "^expected the line 'current' and optionally 'previous', 'overlap_s' and "
            "'previous_until_s', each once$",
        ),
        ("# only a comment", "expected the line"),
        (f"previous {HEX}", "expected the line"),
        (f"current {HEX}\nnext {HEX}", "expected the line"),
        (f"current {HEX}\ncurrent {HEX}", "expected the line"),
        (HEX, "neither 32 bytes nor lines"),
        (f"current {HEX} {HEX}", "neither 32 bytes nor lines"),
        (f"current {HEX[:-2]}", "64 hexadecimal digits"),
        (f"current {HEX[:-1]}x", "64 hexadecimal digits"),
        (f"current {HEX}\nprevious x", "64 hexadecimal digits"),
        *(
            (f"current {HEX}\noverlap_s {wrong}", "overlap_s must be above 0")
            for wrong in ("0", "-1", "nan", "inf", "86401", "soon")
        ),
        *(
            (
                f"current {HEX}\nprevious_until_s {wrong}",
                "^previous_until_s must be seconds since 1970, before the year 10000$",
            )
            for wrong in ("-1", "nan", "inf", "253402300800", "soon")
        ),
    ],
)
def test_the_error_of_a_wrong_file_does_not_show_the_key(text, said):
    with pytest.raises(ValueError, match=said) as caught:
        parse(text.encode())
    assert HEX[:8] not in str(caught.value)
    assert caught.value.__suppress_context__ or caught.value.__context__ is None


def test_bytes_that_are_not_text_are_refused():
    with pytest.raises(ValueError, match="neither 32 bytes"):
        parse(b"\xff" * 40)


def test_the_previous_key_is_valid_for_the_overlap():
    ring = KeyRing(KeySet(A, B, 10.0), now_ns=5 * SECOND_NS)
    assert ring.accepted(15 * SECOND_NS - 1) == (A, B)
    assert ring.accepted(15 * SECOND_NS) == (A,)


def test_a_replaced_key_stays_valid_for_the_overlap():
    ring = KeyRing(KeySet(A))
    ring.replace(KeySet(B, None, 10.0), 100 * SECOND_NS)
    assert ring.current == B
    assert ring.accepted(110 * SECOND_NS - 1) == (B, A)
    assert ring.accepted(110 * SECOND_NS) == (B,)


def test_the_file_says_which_key_is_previous():
    ring = KeyRing(KeySet(A))
    ring.replace(KeySet(B, C, 10.0), 0)
    assert ring.accepted(1) == (B, C)


def test_the_same_key_again_makes_no_previous_key():
    ring = KeyRing(KeySet(A))
    ring.replace(KeySet(A), 0)
    assert ring.accepted(0) == (A,)


def test_a_key_file_has_whole_seconds_since_1970():
    assert write(ROTATED).splitlines()[-1] == "previous_until_s 1795000300"
    assert "until" not in write(ROTATED._replace(until=None))


def test_a_rotation_keeps_the_new_and_the_current_key_only():
    assert KeySet(B, A).rotated(b"c" * 32, MADE, 10.0) == KeySet(C, B, 10.0, MADE + 10.0)
    assert KeySet(A).rotated(b"b" * 32, MADE) == KeySet(B, A, OVERLAP, MADE + OVERLAP)


def test_the_expiry_of_a_rotated_key_is_rounded_up_to_1_s():
    keys = KeySet(A).rotated(b"b" * 32, MADE + 0.25, 10.0)
    assert keys.until == MADE + 11.0
    assert parse(write(keys).encode()) == keys


@pytest.mark.promise("old-keys-expire")
@pytest.mark.parametrize(
    ("wall", "left"),
    [
        (MADE, 300.0),
        (MADE + 100.0, 200.0),
        (MADE + 299.0, 1.0),
        (MADE + 300.0, 0.0),
        (MADE + 1e9, 0.0),
        (MADE - 1.0, 300.0),  # two clocks are never quite the same
        (MADE - 60.0, 300.0),
        (MADE - 61.0, 0.0),
        (0.0, 0.0),
        (None, 300.0),
    ],
)
def test_a_later_start_accepts_the_previous_key_for_less_time(wall, left):
    began_ns = 5 * SECOND_NS
    ring = KeyRing(ROTATED, began_ns, wall)
    end_ns = began_ns + round(left * SECOND_NS)
    assert ring.accepted(end_ns) == (B,)
    assert ring.accepted(max(began_ns, end_ns - 1)) == ((B, A) if left else (B,))


@pytest.mark.parametrize("wall", [MADE, 0.0, MADE + 1e9])
def test_without_an_expiry_the_overlap_counts_from_each_start(wall):
    ring = KeyRing(ROTATED._replace(until=None), now_ns=0, wall=wall)
    assert ring.accepted(300 * SECOND_NS - 1) == (B, A)
    assert ring.accepted(300 * SECOND_NS) == (B,)


@pytest.mark.promise("old-keys-expire")
def test_a_wrong_clock_cannot_extend_the_overlap():
    """The wall clock is read only at the start; then the process uses its monotonic clock."""
    for wall in range(round(MADE) - 400, round(MADE) + 400, 7):
        assert ROTATED.left(float(wall)) <= 300.0


@pytest.mark.parametrize(
    ("keys", "wall", "said"),
    [
        (
            ROTATED,
            MADE + 300.0,
            "refused: valid until 2026-11-18T11:11:40+00:00; drop it: cloudrc key retire FILE",
        ),
        (
            ROTATED,
            0.0,
            "refused: this machine's clock (1970-01-01T00:00:00+00:00) is behind the time when "
            "the key file was written; set the clock",
        ),
        (
            KeySet(B, A),
            MADE,
            "accepted for 300 s after every start, because the key file has no expiry time; "
            "drop it: cloudrc key retire FILE",
        ),
    ],
)
def test_a_doubtful_previous_key_gives_a_warning(keys, wall, said):
    assert keys.warning(wall) == f"the previous key {A.name} is {said}"


@pytest.mark.parametrize("keys", [KeySet(B), ROTATED])
def test_a_valid_previous_key_gives_no_warning(keys):
    assert keys.warning(MADE + 299.0) == ""


@pytest.mark.promise("old-keys-expire")
def test_a_new_file_cannot_extend_the_previous_keys_time():
    ring = KeyRing(ROTATED, now_ns=0, wall=MADE + 300.0)  # it has expired
    ring.replace(KeySet(B, A, 600.0), 10 * SECOND_NS)
    assert ring.accepted(10 * SECOND_NS) == (B,)
    ring = KeyRing(KeySet(B, A, 20.0))
    ring.replace(KeySet(C, A, 600.0), 10 * SECOND_NS)
    assert ring.accepted(20 * SECOND_NS - 1) == (C, A)
    assert ring.accepted(20 * SECOND_NS) == (C,)
    ring.replace(KeySet(C, A, 5.0), 10 * SECOND_NS)
    assert ring.accepted(15 * SECOND_NS) == (C,)


def test_a_previous_key_removed_from_the_file_is_refused():
    ring = KeyRing(KeySet(B, A, 20.0))
    ring.replace(KeySet(B), SECOND_NS)
    assert ring.accepted(SECOND_NS) == (B,)


def test_a_key_may_come_back_by_a_rotation_of_its_own():
    ring = KeyRing(ROTATED, now_ns=0, wall=MADE + 300.0)
    ring.replace(KeySet(A, B, 10.0), SECOND_NS)
    assert ring.accepted(SECOND_NS) == (A, B)
