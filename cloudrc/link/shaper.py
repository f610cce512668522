"""What a pod's sidecar asks of whatever shapes the pod's egress: relay or netem."""

from __future__ import annotations

from typing import Protocol

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.relay_lane import Address


class Shaper(Protocol):
    """Shapes what one pod's tunnel end sends to the other's."""

    @property
    def name(self) -> str:
        """As in `link.mode`: "relay" or "netem"."""
        ...

    def follow_peer(self, peer: Address) -> Address:
        """Shape what goes to this peer from now on.

        Returns:
            The route: where this pod's tunnel end has to send.

        Raises:
            CloudrcError: If it cannot.
        """
        ...

    def follow_profile(self, profile: DirectionProfile, *, restart: bool = False) -> None:
        """Shape by this profile from now on; what is in flight is not lost.

        Args:
            profile: Conditions.
            restart: Whether their time line counts from now; else from when the old one did.

        Raises:
            CloudrcError: If it cannot; then the old profile stays in force.
        """
        ...

    def step(self, timeout: float) -> None:
        """Work or wait, at most about `timeout` [s]."""
        ...

    def counts(self) -> dict[str, int]:
        """Say how many datagrams met which outcome so far."""
        ...

    def released(self) -> dict[str, int]:
        """Say how late datagrams left since the beginning; empty if that is not known here."""
        ...

    def close(self) -> None:
        """Stop shaping and leave nothing behind."""
        ...
