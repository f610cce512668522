# SPDX-License-Identifier: Apache-2.0

"""The request that changes a running link, `PUT /link`, and its answer, as bytes of HTTP.

The process that shapes a direction answers on a Unix socket, which only its own user can open. A
local command connects to the socket; in a cluster, `kubectl exec` carries the bytes. The body is a
JSON object, file name -> text: `follow.PROFILE`, the traces that the profile names, and
`state.CHANGE_FILE`. The answer is the state of the direction, once it has decided.
"""

from __future__ import annotations

from cloudrc.base.errors import RejectedError
from cloudrc.link.state import LinkState, from_text

SOCKET = "link.sock"
"""Name of the socket in a pod, in the folder of the route file."""
APPLY_LIMIT = 5.0
"""Time limit for a direction to decide about a change [s]; usually it takes 0.1 s."""
OK, REFUSED = 200, 422
"""HTTP statuses of the answers: the state, or why the body is no change."""


def put_request(document: str) -> bytes:
    """Format the request that changes a link; `document` is its body."""
    body = document.encode()
    return f"PUT /link HTTP/1.0\r\nContent-Length: {len(body)}\r\n\r\n".encode() + body


def read_answer(answer: bytes) -> LinkState:
    """Return the state of the direction; raise a ValueError if the answer has none.

    Raise a RejectedError with the reason if the direction has found the change invalid.
    """
    head, _, body = answer.partition(b"\r\n\r\n")
    words = head.split()
    status = int(words[1]) if words[1:] and words[1].isdigit() else 0
    if status == REFUSED:
        raise RejectedError(body.decode(errors="replace").strip())
    if status != OK:
        raise ValueError(f"answered with status {status}")
    return from_text(body)
