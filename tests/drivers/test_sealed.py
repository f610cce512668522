"""An end without keys never gets a socket."""

from __future__ import annotations

import ast
import socket
from pathlib import Path

import pytest

from cloudrc.drivers.realtime import Peer, serve
from cloudrc.tunnel.codec import Direction
from cloudrc.tunnel.session import Session
from tests.flights.conftest import bare_world, ring

PACKAGE = Path(__file__).parents[2] / "cloudrc"


def run(endpoint: object) -> list[bytes]:
    """Return what such an end sends within 60 ms."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        other.settimeout(0.01)
        peer = Peer.bind(("127.0.0.1", 0), other.getsockname())
        asked = iter([False] * 3)
        try:
            serve(
                endpoint,  # type: ignore[arg-type]
                peer,
                end="world",
                sink=lambda records: None,
                stop=lambda: next(asked, True),
            )
        finally:
            peer.socket.close()
        heard = []
        while True:
            try:
                heard.append(other.recv(2048))
            except TimeoutError:
                return heard


def test_the_driver_with_a_socket_refuses_an_end_without_keys() -> None:
    with pytest.raises(ValueError, match="world has no key; a process must seal all its datagrams"):
        run(bare_world())


def test_a_sealed_end_runs_and_sends_strangers_nothing() -> None:
    assert run(bare_world(ring=ring())) == []


def test_what_has_keys_is_always_sealed() -> None:
    assert Session(Direction.UPLINK, ring()).sealed
    assert bare_world(ring=ring()).sealed
    assert not bare_world().sealed


def calls(name: str) -> set[str]:
    """Find the package's files that use a name."""
    found = set()
    for path in PACKAGE.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            named = getattr(node, "id", None) or getattr(node, "attr", None)
            if named == name or (isinstance(node, ast.alias) and node.name == name):
                found.add(path.relative_to(PACKAGE).as_posix())
    return found


def test_only_the_drivers_that_ask_send_what_an_end_says() -> None:
    """Each caller of `take_datagrams` has no socket or checks for the seal."""
    takers = {name for name in calls("take_datagrams") if not name.startswith("faults/")}
    assert takers == {"drivers/realtime.py", "drivers/virtual.py"}
    assert "sealed" in (PACKAGE / "drivers" / "realtime.py").read_text()
    imports = ast.parse((PACKAGE / "drivers" / "virtual.py").read_text())
    names = {alias.name for node in ast.walk(imports) if isinstance(node, ast.Import)
             for alias in node.names}  # fmt: skip
    assert "socket" not in names


def test_only_the_ends_make_a_session() -> None:
    users = {"cli/bench.py", "tunnel/handshake.py", "tunnel/session.py"}
    assert calls("Session") - users == {"tunnel/end.py"}


@pytest.mark.parametrize("end", ["world", "cloud"])
def test_the_commands_of_the_ends_always_give_keys(end: str) -> None:
    tree = ast.parse((PACKAGE / "cli" / f"{end}.py").read_text())
    text = ast.unparse(tree)
    assert "keys.ring" in text
    assert "required=True" in (PACKAGE / "cli" / "runtime.py").read_text().split('"--key"')[1][:80]
