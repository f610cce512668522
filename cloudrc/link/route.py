"""Files of the shared folder that others read while they are written: whole, or not there."""

from __future__ import annotations

from pathlib import Path

from cloudrc.files import put


def publish(path: Path, text: str) -> None:
    """Write a file in one step, as far as its readers can see.

    Args:
        path: The file; its folder exists.
        text: What stands in it from now on.
    """
    put(path, text.encode("utf-8"))


def publish_route(path: Path, route: tuple[str, int]) -> None:
    """Tell this pod's tunnel end where it has to send: one line HOST:PORT."""
    publish(path, f"{route[0]}:{route[1]}\n")


def withdraw(path: Path) -> None:
    """Remove a file, if it is there."""
    path.unlink(missing_ok=True)
