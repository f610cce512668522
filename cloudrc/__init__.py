# SPDX-License-Identifier: Apache-2.0

"""cloudrc: a testbed for robots that are controlled from the cloud."""

from typing import TYPE_CHECKING, Any

from cloudrc.version import __version__

if TYPE_CHECKING:
    from cloudrc.base.errors import (
        BadInputError,
        CloudrcError,
        MissingPrerequisiteError,
        TimedOutError,
    )
    from cloudrc.doors.api import (
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
    from cloudrc.teleop.client import Api

_HOMES = {
    "Api": "cloudrc.teleop.client",
    **dict.fromkeys(
        ("BadInputError", "CloudrcError", "MissingPrerequisiteError", "TimedOutError"),
        "cloudrc.base.errors",
    ),
    **dict.fromkeys(("Comparison", "Result", "SweepTable"), "cloudrc.doors.api"),
    **dict.fromkeys(
        ("compare", "fly", "identify", "margin", "sweep", "verify"), "cloudrc.doors.api"
    ),
}
"""Public name -> the module that defines it."""

__all__ = [
    "Api",
    "BadInputError",
    "CloudrcError",
    "Comparison",
    "MissingPrerequisiteError",
    "Result",
    "SweepTable",
    "TimedOutError",
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
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'cloudrc' has no attribute {name!r}")
