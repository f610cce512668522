# SPDX-License-Identifier: Apache-2.0

"""Where the processes of a local run meet: files, sockets and addresses."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from cloudrc.link.follow import PROFILE
from cloudrc.results.under_way import flights_folder

PATH_MAX = 107
"""Longest path of a socket, without its final zero [bytes]. Source: unix(7), `sun_path`."""
SOCKET_NAME = "/cloudrc-12345678/downlink.sock"
"""Longest path of a socket, relative to the folder for temporary files."""
API_FILE = "api.json"
"""File in a run's folder: the API's address."""
LINK_FOLDER, ROUTE_FILE = "link", "route"
"""Folder in a run's folder, during the flight: the link's profile, and a folder per direction with
the address of the relay (`ROUTE_FILE`) and the state of the link."""
LINK_LOG = "uplink.log"
"""File in the folder of every run in real time."""


class RobotProcesses(NamedTuple):
    """The files and addresses of the processes of a robot."""

    folder: Path  # of the recording
    sockets: Path  # private folder
    at: Mapping[str, str]  # process -> HOST:PORT at which it receives

    @property
    def url(self) -> str:
        """Address of the API."""
        return f"unix:{self.sockets}/api.sock"


def link_socket(url: str, way: str) -> Path:
    """Return the socket on which a direction of a run's link can be changed.

    `url` is the address of the run's API, `way` "uplink" or "downlink".
    """
    return Path(url.removeprefix("unix:")).with_name(f"{way}.sock")


def link_words(folder: Path, way: str) -> list[str]:
    """Return the arguments of `cloudrc` for the process that shapes the direction `way` of a link.

    `way` is "uplink" or "downlink". `folder` contains profile.yaml and a folder per direction, in
    which the process writes its route file and its state.
    """
    files = [f"--profile={folder / PROFILE}", f"--route={folder / way / ROUTE_FILE}"]
    return ["link", "run", f"--direction={way}", *files]


def socket_folder() -> str:
    """Choose a folder for the sockets of a run: on this machine, with a short path, not cleaned.

    Some machines clean /tmp during a flight; then no command could stop the robot. Therefore the
    folder is beside the flight files, if their path is short enough.
    """
    beside = flights_folder()
    folder = str(beside.parent) if beside else "/tmp"
    return folder if len(os.fsencode(folder)) + len(SOCKET_NAME) <= PATH_MAX else "/tmp"
