# SPDX-License-Identifier: Apache-2.0

"""The codec of openpi's wire: what passes, and what is refused."""

import msgpack
import numpy as np
import pytest

from cloudrc.flight.pod.openpi.codec import WireError, pack, unpack
from tests.tensors import KINDS, Tensor


@pytest.mark.parametrize(
    "array",
    [
        np.arange(12, dtype="<f4").reshape(3, 4),
        np.zeros((2, 3, 3), np.uint8),
        np.array(["pick", "place it"]),
    ],
    ids=lambda array: f"{array.dtype}{array.shape}",
)
def test_an_array_arrives_as_it_was(array):
    found = unpack(pack({"a": array}))["a"]
    assert found.dtype == array.dtype
    assert np.array_equal(found, array)
    assert found.flags.writeable


def test_scalars_texts_and_nested_values_arrive_as_they_were():
    message = {"x": np.float32(0.1), "n": 3, "prompt": "é", "in": {"a": [1, None, {"b": 2.5}]}}
    found = unpack(pack(message))
    assert found == message
    assert type(found["x"]) is np.float32


def test_the_bytes_are_those_of_openpi():
    """Its client names the parts of an array in bytes, not in text."""
    found = msgpack.unpackb(pack({"a": np.ones((1, 2), "<f4")}))["a"]
    data = np.ones(2, "<f4").tobytes()
    assert found == {b"__ndarray__": True, b"data": data, b"dtype": "<f4", b"shape": [1, 2]}


class Image:
    def __array__(self, dtype=None, copy=None):
        return np.ones(2)


@pytest.mark.parametrize("value", [Image(), *(Tensor([1.0, 1.0], **kind) for kind in KINDS)])
def test_what_numpy_converts_and_any_tensor_is_sent_as_an_array(value):
    assert unpack(pack({"a": value}))["a"].tolist() == [1.0, 1.0]


def in_texts(array):
    """Return openpi's form with keys that are texts, as programs in other languages write them."""
    key = "__npgeneric__" if isinstance(array, np.generic) else "__ndarray__"
    data = array.item() if isinstance(array, np.generic) else array.tobytes()
    return {key: True, "data": data, "dtype": array.dtype.str, "shape": array.shape}


def in_msgpack_numpy(array):
    """Return what the package msgpack-numpy 0.4.8 packs."""
    found = {b"nd": True, b"type": array.dtype.str, b"data": array.tobytes()}
    if isinstance(array, np.generic):
        return {**found, b"nd": False}
    return {**found, b"kind": b"", b"shape": array.shape}


@pytest.mark.parametrize("write", [in_texts, in_msgpack_numpy])
@pytest.mark.parametrize("array", [np.arange(6, dtype="<f4").reshape(2, 3), np.float32(1.5)])
def test_the_other_dialects_of_numpy_are_read(write, array):
    found = unpack(msgpack.packb({"in": {"a": write(array)}}))["in"]["a"]
    assert type(found) is type(array)
    assert found.dtype == array.dtype
    assert np.array_equal(found, array)


def array(**change):
    found = {"__ndarray__": True, "data": bytes(8), "dtype": "<f4", "shape": [2]} | change
    return {key.encode(): value for key, value in found.items()}


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"dtype": "|O"}, "not carried"),
        ({"shape": [3]}, "no shape of an array of 8 bytes"),
        ({"shape": []}, "8 bytes, not 4"),
    ],
)
def test_a_wrong_array_is_refused(change, text):
    with pytest.raises(WireError, match=text):
        unpack(msgpack.packb({"a": array(**change)}))
