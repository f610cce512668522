# SPDX-License-Identifier: Apache-2.0

"""Make a link profile from the packet opportunities that mahimahi has recorded."""

from __future__ import annotations

import os
from pathlib import Path
from shlex import quote

from cloudrc.base.files import at_place
from cloudrc.base.outside.document import write_yaml
from cloudrc.base.outside.paths import check_there
from cloudrc.link.opportunities import BYTES
from cloudrc.link.traces import RATE_SUFFIXES, read_opportunities


def is_capacity(source: Path) -> bool:
    """Return whether the name of a file is that of a capacity trace."""
    return source.suffix in RATE_SUFFIXES


def write_rate_profile(source: Path, path: Path, direction: str | None) -> list[str]:
    """Write a profile that replays a capacity trace; describe it in lines.

    `direction` is that of the trace; None: what the end of its name says.
    """
    check_there(source, "name a capacity trace")
    times_ns, way = read_opportunities(source), direction or RATE_SUFFIXES[source.suffix]
    period = times_ns[-1] / 1e9
    rate = len(times_ns) * BYTES * 8e-3 / period
    about = f"{rate:.4g} kbit/s on average in {period:.4g} s, as {source.name}"
    named = os.path.relpath(source.resolve(), path.resolve().parent)
    with at_place(path):
        text = write_yaml({"description": about, way: {"delay_ms": 0, "rate_trace": named}})
        path.write_text(text, encoding="utf-8")
    other = next(each for each in RATE_SUFFIXES.values() if each != way)
    return [
        f"{path}: the {way} has {len(times_ns)} opportunities of {BYTES} bytes, {about}",
        f"  fly:      --set link.profile={quote(str(path))} --set link.{way}.delay_ms=20",
        f"  to add:   {other}: {{rate_trace: FILE{_suffix(other)}}}; mahimahi records no delays",
    ]


def _suffix(way: str) -> str:
    return next(suffix for suffix, each in RATE_SUFFIXES.items() if each == way)
