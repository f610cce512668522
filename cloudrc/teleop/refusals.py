# SPDX-License-Identifier: Apache-2.0

"""Define why teleop cannot do what a request asks for."""

from __future__ import annotations

from cloudrc.base.errors import CloudrcError


class UnknownMissionError(CloudrcError):
    """Report that no mission has this id."""

    status = 404  # of the API's answer


class UnavailableError(CloudrcError):
    """Report that teleop cannot act now, for example because the disk is full."""

    status = 503


class ConflictError(CloudrcError):
    """Report a request that the present state forbids.

    `mission` is the id of the mission that blocks the request; "" if no mission blocks it.
    """

    exit_code, status = 5, 409

    def __init__(self, text: str, mission: str = "") -> None:
        super().__init__(text)
        self.mission = mission
