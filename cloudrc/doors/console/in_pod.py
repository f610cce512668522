# SPDX-License-Identifier: Apache-2.0

"""The console in a pod, which has no right to change the link of its release."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from cloudrc.config.load import load_link
from cloudrc.doors.console.access import page_token
from cloudrc.doors.console.serve import ConsoleTarget
from cloudrc.doors.console.steering import LinkControl
from cloudrc.teleop.client import Api

LINK_SET = "link set "
"""Start of a line that a pod's console prints to request a change of the link."""
OWN_S = 150.0
"""Time for which the page in a pod shows a requested value of the link [s]. Afterwards the page
shows the value in the profile's file, which Kubernetes has updated by then."""
NOTE = " requested; only 'cloudrc console --cluster' carries it out"
"""Text in the page's answer to a change of the link."""


def flight_of_pod(
    config: Path,
    profile: Path,
    api: str,
    token: Callable[[], str] | None,
    say: Callable[[str], None],
) -> ConsoleTarget:
    """Return the flight of the pod in which this process runs.

    Args:
        config: Experiment file.
        profile: File of the link profile.
        api: URL of teleop's API.
        token: Returns the token of the API; None: there is none.
        say: Prints a line in the pod's log. `cloudrc console --cluster` reads the changes of the
            link that the operator asks for there, and carries them out with its user's rights.
    """
    own: dict[str, tuple[float, float]] = {}  # key -> last requested value, and when [s]

    def read() -> dict[str, Any]:
        tree = load_link(profile, config).model_dump(mode="json", exclude_defaults=True)
        for key, (value, at) in own.items():
            if time.monotonic() - at < OWN_S:
                way, _, name = key.partition(".")
                tree[way] = {**tree.get(way, {}), name: value}
        return tree

    def change(settings: Sequence[str]) -> None:
        pairs = (setting.split("=") for setting in settings)
        own.update({key: (float(value), time.monotonic()) for key, value in pairs})
        say(f"{LINK_SET}{' '.join(settings)}")

    operator = token or str
    return ConsoleTarget(
        config,
        Api(api, operator),
        LinkControl(read, change, NOTE),
        has_ended=lambda: False,
        token=(lambda: page_token(operator())) if token else None,
    )
