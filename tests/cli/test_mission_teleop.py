"""`cloudrc teleop`: each reason not to start is one sentence."""

import socket
import subprocess
import sys

import pytest

from cloudrc.cli import extras
from cloudrc.cli.main import main

WORDS = ["teleop", "--config", "hover", "--socket"]


def test_without_fastapi_the_api_is_refused_and_the_extra_named(monkeypatch, tmp_path, capsys):
    monkeypatch.setitem(extras.EXTRAS, "api", ("fastapi_is_not_here",))
    assert main([*WORDS, str(tmp_path), "--api", "127.0.0.1:0"]) == 3
    assert "pip install 'cloudrc[api]'" in capsys.readouterr().err


@pytest.mark.process
def test_a_missing_resource_is_named(tmp_path):
    token = tmp_path / "operator"
    token.touch(0o600)
    token.write_text("a-token-of-the-operator")
    tokens = f"--tokens={tmp_path}"
    with socket.create_server(("127.0.0.1", 0)) as taken:
        api = f"--api=127.0.0.1:{taken.getsockname()[1]}"
        cases = {
            (str(tmp_path), api, tokens): "choose another address",
            (str(tmp_path), api): "--api HOST:PORT needs --tokens DIR",
            ("x" * 200,): "longer than 107 bytes",
            (str(tmp_path), "--api=nowhere"): "nowhere' is not HOST:PORT",
            (str(tmp_path), "--journal=/proc/journal"): "/proc/journal",
        }
        for words, said in cases.items():
            command = [sys.executable, "-m", "cloudrc", *WORDS, *words]
            done = subprocess.run(command, capture_output=True, text=True, timeout=30)
            assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
            assert said in done.stderr
