# SPDX-License-Identifier: Apache-2.0

"""Pack maps with numpy arrays as msgpack, in the form of openpi; never as pickle.

An array is a map with the keys `__ndarray__`, `data`, `dtype` and `shape`, which are bytes. A
scalar of numpy is a map with the keys `__npgeneric__`, `data` and `dtype`. Two other forms are
read, too: these keys as texts, and the form of the package msgpack-numpy, with the keys `nd`,
`type`, `kind`, `shape` and `data`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import msgpack
import numpy as np

from cloudrc.base.outside.values import shorten, to_arrays

MESSAGE_MAX = 64 << 20
"""Largest message [bytes]; three raw color images of 1920 x 1080 pixels take 19 MB."""
KINDS = "biufSU"
"""Kinds of numpy's types that pass: booleans, integers, floats, bytes and texts. Objects would need
pickle."""
DTYPE_MAX = 16
"""Largest length of the name of a type [characters]."""
ARRAY, SCALAR = b"__ndarray__", b"__npgeneric__"


class WireError(ValueError):
    """A message that this wire does not carry."""


def pack(message: Mapping[str, Any]) -> bytes:
    """Pack a map of numbers, texts, lists, maps and arrays; raise a WireError for other values."""
    try:
        data = cast(bytes, msgpack.packb(dict(message), default=_to_map))
    except (TypeError, ValueError, OverflowError, RecursionError) as error:
        raise WireError(f"a message cannot be packed: {error}") from None
    if len(data) > MESSAGE_MAX:
        raise WireError(f"a message of {len(data)} bytes; the limit is {MESSAGE_MAX}")
    return data


def unpack(data: bytes) -> dict[Any, Any]:
    """Unpack a map; raise a WireError for anything else."""
    try:
        message = msgpack.unpackb(
            data, object_hook=_from_map, ext_hook=_no_extension, strict_map_key=False
        )
    except WireError:
        raise
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise WireError(f"no valid msgpack: {type(error).__name__} {error}".rstrip()) from None
    if not isinstance(message, dict):
        raise WireError(f"{shorten(message)} in place of a map")
    return message


def _to_map(value: Any) -> dict[bytes, Any]:
    """Convert arrays and scalars of numpy, and what numpy converts to an array."""
    if isinstance(value, np.generic):
        return {SCALAR: True, b"data": value.item(), b"dtype": _name_of(value.dtype)}
    if not hasattr(value, "__array__"):
        raise WireError(f"{shorten(value)} cannot be packed; send numbers, texts and arrays")
    array = np.asarray(to_arrays(value))
    name = _name_of(array.dtype)
    return {ARRAY: True, b"data": array.tobytes(), b"dtype": name, b"shape": array.shape}


def _name_of(dtype: np.dtype[Any]) -> str:
    if dtype.kind not in KINDS:
        raise WireError(f"an array of type {dtype}; convert it to numbers")
    return dtype.str


def _from_map(found: dict[Any, Any]) -> Any:
    named = {
        key.decode(errors="replace") if isinstance(key, bytes) else key: value
        for key, value in found.items()
    }
    if "__ndarray__" in named:
        return _to_array(named.get("dtype"), named.get("shape"), named.get("data"))
    if "__npgeneric__" in named:
        dtype, data = _read_dtype(named.get("dtype")), named.get("data")
        try:
            return dtype.type(data)
        except (TypeError, ValueError, OverflowError):
            raise WireError(f"{shorten(data)} is no {dtype}") from None
    if {"nd", "type", "data"} <= named.keys():
        array = _to_array(named["type"], named.get("shape", []), named["data"])
        return array if named["nd"] else array[()]  # a scalar has no shape
    return found


def _to_array(name: Any, shape: Any, data: Any) -> Any:
    dtype = _read_dtype(name)
    if not isinstance(data, bytes):
        raise WireError(f"{shorten(data)} in place of an array's bytes")
    try:
        found = np.ndarray(tuple(shape), dtype, data)
    except (TypeError, ValueError):
        raise WireError(f"{shorten(shape)} is no shape of an array of {len(data)} bytes") from None
    if found.nbytes != len(data):
        raise WireError(f"an array has {len(data)} bytes, not {found.nbytes}")
    return (
        found.copy()
    )  # a policy may change its observation, and the message's bytes cannot change


def _read_dtype(name: Any) -> np.dtype[Any]:
    try:
        dtype = np.dtype(str(name)[:DTYPE_MAX])
    except (TypeError, ValueError, SyntaxError):
        raise WireError(f"{shorten(name)} is no type of an array") from None
    if dtype.kind not in KINDS or not dtype.itemsize:
        raise WireError(f"arrays of type {dtype} are not carried; send numbers")
    return dtype


def _no_extension(code: int, data: bytes) -> Any:
    raise WireError(f"the extension {code} of msgpack, with {len(data)} bytes")
