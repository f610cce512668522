# SPDX-License-Identifier: Apache-2.0

"""cloudrc: a testbed for robots that are controlled from the cloud."""

from typing import TYPE_CHECKING, Any

from cloudrc.version import __version__

if TYPE_CHECKING:
    from cloudrc.api import (
        Comparison,
        Result,
        SweepTable,
        compare,
        fly,
        identify,
        margin,
        sweep,
        verify,
    )

__all__ = [
    "Comparison",
    "Result",
    "SweepTable",
    "__version__",
    "compare",
    "fly",
    "identify",
    "margin",
    "sweep",
    "verify",
]


def __getattr__(name: str) -> Any:
    # Lazily, because the processes of a flight import cloudrc, too, and must start fast.
    if name in __all__:
        from cloudrc import api

        return getattr(api, name)
    raise AttributeError(f"module 'cloudrc' has no attribute {name!r}")
