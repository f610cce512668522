"""Which addresses `cloudrc relay tcp` refuses before it relays."""

import socket
from unittest.mock import Mock

import pytest

from cloudrc.cli.main import main
from cloudrc.runs.links.streams import _is_same


@pytest.mark.parametrize(
    ("listen", "to", "same"),
    [
        ("127.0.0.1", "127.0.0.1", True),
        ("0.0.0.0", "127.3.2.1", True),
        ("::", "::1", True),
        ("127.0.0.1", "127.0.0.2", False),
        ("0.0.0.0", "192.0.2.1", False),
    ],
)
def test_the_relay_knows_its_own_address(listen, to, same):
    assert _is_same((listen, 8000), (to, 8000)) is same
    assert not _is_same((listen, 8000), (to, 8001))


@pytest.mark.parametrize("host", ["localhost", "127.0.0.1"])
def test_a_relay_to_itself_is_refused(host, capsys, monkeypatch):
    relays = Mock(side_effect=AssertionError)  # it would relay for ever
    monkeypatch.setattr("cloudrc.runs.links.streams.StreamRelay", relays)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    line = f"relay tcp --listen 127.0.0.1:{port} --to {host}:{port}"
    assert main(line.split()) == 2
    said = capsys.readouterr().err
    assert f"--to {host}:{port}: this is the relay's own address, --listen 127.0.0.1:{port}" in said
