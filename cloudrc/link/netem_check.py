"""What is in force, as the kernel tells it: tc's words and its listing go in, differences come out.

tc and the kernel clamp numbers without a word: a rate below 1 byte/s becomes none, a chance below
2**-32 becomes 0, a number of 32 bits wraps. What they made of ours is read back and compared.

Source: iproute2 tc/q_netem.c, netem_print_opt.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

_TIME = re.compile(r"(?P<value>[\d.]+)us")
_RELATIVE = 1e-3
"""Rounding that nobody notices, as a share of the number."""
_TICK = 64e-9
"""Of tc's clock [s]."""
_CHANCE = 2.0**-30
"""A few steps of a chance of 32 bits, which is cut into percents with 9 digits."""

# Option of tc -> the object and the keys in its listing; what is not listed is 0.
_LISTED = {
    "limit": ("", ("limit",)),
    "delay": ("delay", ("delay", "jitter", "correlation")),
    "random": ("loss-random", ("loss",)),
    "gemodel": ("loss-gemodel", ("p", "r", "1-h", "1-k")),
    "duplicate": ("duplicate", ("duplicate",)),
    "corrupt": ("corrupt", ("corrupt",)),
    "reorder": ("reorder", ("reorder",)),
    "rate": ("rate", ("rate",)),
}


def differences(words: Sequence[str], listed: Mapping[str, Any]) -> list[str]:
    """Compare what tc was asked for with what it says is in force.

    Args:
        words: As `netem_text.options` gives them.
        listed: "options" of the qdisc, as `tc -j qdisc show` prints them.

    Returns:
        One text per number that is not what was asked: "rate: asked 0.5, in force 0".
    """
    found = []
    for option, keys, asked in _asked(words):
        inside = listed if not keys[0] else listed.get(keys[0], {})
        for key, value in zip(keys[1], asked, strict=False):
            shown = float(inside.get(key, 0.0))
            near = abs(shown - value) <= max(_slack(option), _RELATIVE * abs(value))
            if not near or (value and not shown):
                name = key if len(keys[1]) == 1 else f"{option} {key}"
                found.append(f"{name}: asked {value:g}, in force {shown:g}")
    return found


def _asked(words: Sequence[str]) -> Iterator[tuple[str, tuple[str, tuple[str, ...]], list[float]]]:
    """Take tc's words apart: each option with where it is listed and its numbers in SI."""
    option, numbers = "", list[float]()
    for word in [*words, "end"]:
        if word in _LISTED or word in ("loss", "distribution", "end"):
            if option:
                yield option, _LISTED[option], numbers
            option, numbers = word if word in _LISTED else "", []
        elif option:
            numbers.append(_number(word))


def _number(word: str) -> float:
    """Read a number of tc's: times in [s], chances in [0, 1], rates in [byte/s], others as is."""
    if match := _TIME.fullmatch(word):
        return float(match["value"]) * 1e-6
    if word.endswith("%"):
        return float(word[:-1]) * 1e-2
    for unit, scale in (("gbit", 1.25e8), ("bit", 0.125)):
        if word.endswith(unit):
            return float(word.removesuffix(unit)) * scale
    return float(word)


def _slack(option: str) -> float:
    if option in ("limit", "rate"):
        return 0.0
    return 2 * _TICK if option == "delay" else _CHANCE
