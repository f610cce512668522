# SPDX-License-Identifier: Apache-2.0

"""The address of a policy's server."""

from __future__ import annotations

from urllib.parse import urlsplit


def check_url(url: str) -> str:
    """Return the address of a policy's server; raise a ValueError if it is none."""
    try:
        parts = urlsplit(url)
        valid = parts.scheme in ("ws", "wss") and bool(parts.hostname) and parts.port != 0
    except ValueError:
        valid = False
    if not valid:
        raise ValueError(
            f"'{url}' is no address of a policy's server; give scheme, host and port, such as "
            "ws://127.0.0.1:8000"
        )
    return url
