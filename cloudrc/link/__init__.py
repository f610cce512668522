# SPDX-License-Identifier: Apache-2.0

"""The network between world and cloud: netem or a relay acts as a profile says.

For programs, the package is a library: `cloudrc.link.open` gives the model of both directions.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloudrc.link.library import LinkProfile, OneWay, open, read_profile
    from cloudrc.link.profile import (
        Blackout,
        Change,
        DirectionProfile,
        GilbertElliott,
        Radio,
        Trace,
    )
    from cloudrc.link.queue import PacketQueue
    from cloudrc.link.streams import Numbers

_HOMES = {
    **dict.fromkeys(("LinkProfile", "OneWay", "open", "read_profile"), "library"),
    "Numbers": "streams",
    **dict.fromkeys(
        ("Blackout", "Change", "DirectionProfile", "GilbertElliott", "Radio", "Trace"), "profile"
    ),
    "PacketQueue": "queue",
}
"""Public name -> the module that defines it."""

__all__ = [
    "Blackout",
    "Change",
    "DirectionProfile",
    "GilbertElliott",
    "LinkProfile",
    "Numbers",
    "OneWay",
    "PacketQueue",
    "Radio",
    "Trace",
    "open",
    "read_profile",
]


def __getattr__(name: str) -> Any:
    # Lazily, because processes without numpy use modules of this package, too.
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'cloudrc.link' has no attribute {name!r}")
