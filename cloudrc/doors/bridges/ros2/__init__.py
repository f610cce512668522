# SPDX-License-Identifier: Apache-2.0

"""ROS 2: cloudrc as a node beside a user's nodes.

Only this folder imports rclpy, and nothing imports this folder unless an experiment asks for ROS.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from cloudrc.base.errors import CloudrcError, MissingPrerequisiteError, to_one_line


@contextmanager
def saying(text: str, kind: type[CloudrcError] = MissingPrerequisiteError) -> Iterator[None]:
    """Raise an error with `text` in place of any exception; ROS has many kinds of them.

    The word WHY in the text becomes that of the exception.
    """
    try:
        yield
    except Exception as error:
        why = to_one_line(str(error).partition(", at ")[0])  # without the place in the code of ROS
        raise kind(text.replace("WHY", why)) from None


def require_ros(purpose: str, module: str, packages: str) -> None:
    """Raise a MissingPrerequisiteError unless this process can be a node of ROS 2.

    `purpose`, such as "cloud.controller ros2", is for the error text. `module` is the module of
    this folder that is needed; its `load_messages` loads those of the ROS packages `packages`.
    """
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    with saying(
        f"{purpose} needs ROS 2 with {packages} (WHY): run "
        f"'source /opt/ros/DISTRIBUTION/setup.bash' of a ROS 2 for {python}, then cloudrc again"
    ):
        import rclpy  # noqa: F401  first: its error says most

        importlib.import_module(f"cloudrc.doors.bridges.ros2.{module}").load_messages()
