# SPDX-License-Identifier: Apache-2.0

"""Numbers from outside: what is one, and what the error says."""

from math import inf

import numpy as np
import pytest

from cloudrc.base.outside.values import (
    ANY,
    RESULT,
    WHOLE,
    InvalidValueError,
    Quantity,
    to_boolean,
    to_plain,
)
from tests.base.outside.values import OBJECTS, TEXTS, disagreements


@pytest.mark.parametrize(
    "quantity", [ANY, WHOLE, Quantity(gt=0.0), Quantity("ms", 1, 7, whole=True)], ids=str
)
def test_a_text_or_an_object_is_a_number_or_refused(quantity):
    assert disagreements(TEXTS.items(), quantity, quantity.read, InvalidValueError) == []
    assert disagreements(OBJECTS, quantity, quantity.of, InvalidValueError) == []


def test_a_number_has_the_type_of_its_quantity():
    assert [type(WHOLE.of(each)) for each in (5, np.int64(5), np.uint8(5))] == [int] * 3
    assert [type(ANY.of(each)) for each in (5, np.float16(5), np.int64(5))] == [float] * 3
    assert WHOLE.of(2**53 + 1) == WHOLE.read(str(2**53 + 1)) == 2**53 + 1


def test_the_error_says_what_is_valid():
    with pytest.raises(InvalidValueError, match=r"^'7' is not a number > 0 and <= 5 \[s\]$"):
        Quantity("s", gt=0, le=5).read("7")
    with pytest.raises(InvalidValueError, match=r"^its age is 7, not a whole number <= 5$"):
        Quantity(le=5, whole=True).of(7, "age")


@pytest.mark.parametrize(
    "values",
    [
        [1.0, True],
        [[1.0], [1.0, 2.0]],
        np.array([1.0, np.nan]),
        np.array([True]),
        np.ma.array([1.0, 2.0], mask=[False, True]),
        np.array([1e31]),
        [1.0, inf],
        "12",
        [None],
        {1.0, 2.0},
    ],
    ids=str,
)
def test_an_array_of_numbers_has_nothing_else(values):
    with pytest.raises(InvalidValueError):
        RESULT.array(values)


def test_an_array_keeps_its_type_and_its_bits():
    assert RESULT.array(np.ones((2, 3), np.float32)).dtype == np.float32
    assert RESULT.array([[1, 2], [3, 4]]).tolist() == [[1, 2], [3, 4]]
    assert RESULT.array(np.array([0.5], object)).tolist() == [0.5]
    assert RESULT.row([np.float32(0.5), 1], 2) == (0.5, 1.0)
    with pytest.raises(
        InvalidValueError, match=r"^its velocity at \[1\] is 'x', not a finite number"
    ):
        RESULT.row((1.0, "x"), 2, "velocity")


@pytest.mark.parametrize(("value", "holds"), [(True, True), (np.False_, False), (1, True)])
def test_a_truth_value_is_one(value, holds):
    assert to_boolean(value) is holds
    for wrong in ("False", 2, None, np.array([True])):
        with pytest.raises(InvalidValueError):
            to_boolean(wrong)


def test_a_mapping_of_numpy_becomes_plain():
    given = {"a": np.arange(2), "b": (np.float32(0.5), np.True_, None, "x"), 3: {"c": 10**18}}
    plain = {"a": [0, 1], "b": [0.5, True, None, "x"], "3": {"c": 10**18}}
    assert to_plain(given) == plain
    with pytest.raises(InvalidValueError):
        to_plain({"a": object()})
