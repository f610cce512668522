"""Two Unix sockets that know each other."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from cloudrc.drivers.teleop import UnixPeer


@pytest.fixture
def peers(tmp_path: Path) -> Iterator[tuple[UnixPeer, UnixPeer]]:
    """That of teleop or of cloud first, as a test likes."""
    paths = tmp_path / "a.sock", tmp_path / "b.sock"
    pair = UnixPeer(*paths), UnixPeer(*reversed(paths))
    yield pair
    for peer in pair:
        peer.close()
