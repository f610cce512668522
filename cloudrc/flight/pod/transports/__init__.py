# SPDX-License-Identifier: Apache-2.0

"""Transports to programs outside that control the robot.

A transport is a plug-in of the kind `transports`: a file here, or a module that an entry point in
the group `cloudrc.transports` names. It defines:

- `check()` raises a MissingPrerequisiteError if this machine lacks what the transport needs;
- `lock_step(place, start_limit, gone)` connects in virtual time, and returns a
  `ControllerTransport` of `cloud.controllers.remote` with a method `close()`;
- `driver(peer, place, start_limit, tell)` connects in real time, in a process beside cloud; the
  method `run(stop)` of what it returns serves cloud by `peer` until `stop()` is true.

`place` is where the program is, and `start_limit` the time limit for its first answer [s].
`gone()` says whether the program has ended; `tell` gets words for the user.
"""

from __future__ import annotations

from cloudrc.base import plugins
from cloudrc.base.errors import CloudrcError, MissingPrerequisiteError


def find_transport(name: str) -> plugins.Found:
    """Import a transport by name or path.

    The error about a name that is not installed tells the extra that installs it.
    """
    try:
        return plugins.find("transports", name)
    except CloudrcError as error:
        if plugins.is_path(name):
            raise
        text = f"{error}; run: pip install 'cloudrc[policy]'"
        raise MissingPrerequisiteError(text) from None
