"""World, cloud and relay as commands: an address that cannot be used is said with its flag."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest

from cloudrc.cli.main import main
from cloudrc.config.shipped import FOLDERS

CONFIG = ["--config", str(FOLDERS["experiment"] / "hover.yaml")]
FREE = "127.0.0.1:9"


@pytest.fixture
def taken() -> Iterator[str]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        yield f"127.0.0.1:{holder.getsockname()[1]}"


# The socket that could not be bound is closed by the end of the process, which here goes on.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("command", "flag", "others"),
    [
        ("world", "--listen", ["--peer", FREE]),
        ("cloud", "--listen", ["--peer", FREE]),
        ("relay", "--world-side", ["--cloud-side", FREE, "--world", FREE, "--cloud", FREE]),
    ],
)
def test_an_address_in_use_is_named_with_its_flag(
    command: str, flag: str, others: list[str], taken: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command, *CONFIG, flag, taken, *others]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"cloudrc: error: {flag} {taken}: cannot receive there: Address already")
    assert said.endswith("; name an address of this machine and a port that is free\n")
