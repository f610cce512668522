"""Which addresses `cloudrc relay tcp` refuses before it relays."""

import socket
from unittest.mock import Mock

import pytest

from cloudrc.cli.main import main


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
