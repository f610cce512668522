"""World, cloud and relay as commands: addresses, stopping at start, sizes."""

from __future__ import annotations

import argparse
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest

from cloudrc import assembly
from cloudrc.cli.main import main
from cloudrc.cli.runtime import (
    _open_peer,
    ipv4_addresses,
    open_exporter,
    read_address,
    read_size,
    resolve_address,
    show_address,
)
from cloudrc.config.shipped import FOLDERS
from cloudrc.errors import BadInputError
from cloudrc.records import MissionEvent

CONFIG = ["--config", str(FOLDERS["experiment"] / "hover.yaml")]
FREE = "127.0.0.1:9"
MCAP_MAGIC = b"\x89MCAP0\r\n"


def free_port() -> str:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def taken() -> Iterator[str]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as holder:
        holder.bind(("127.0.0.1", 0))
        yield f"127.0.0.1:{holder.getsockname()[1]}"


@pytest.mark.parametrize("elsewhere", [None, Path("sockets")])
def test_cloud_with_a_teleop_process_exports_no_mission_metrics(
    elsewhere: Path | None,
) -> None:
    options = argparse.Namespace(metrics=("127.0.0.1", 0), teleop=elsewhere)
    exporter = open_exporter(options, "cloud")
    assert exporter is not None
    exporter.see([MissionEvent(0, "started", 0, "")])
    assert ("cloudrc_mission_state" in exporter.text()) is (elsewhere is None)
    exporter.close()


# The process would close the socket at its end, but here the test process goes on.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize(
    ("command", "flag", "others"),
    [
        ("world", "--listen", ["--peer", FREE, "--key", "KEY"]),
        ("cloud", "--listen", ["--peer", FREE, "--key", "KEY"]),
        ("relay", "--world-side", ["--cloud-side", FREE, "--world", FREE, "--cloud", FREE]),
    ],
)
def test_an_address_in_use_is_reported_with_its_flag(
    command: str,
    flag: str,
    others: list[str],
    taken: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "key").write_bytes(b"k" * 32)
    (tmp_path / "key").chmod(0o600)
    others = [str(tmp_path / "key") if word == "KEY" else word for word in others]
    assert main([command, *CONFIG, flag, taken, *others]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        f"cloudrc: error: {flag} {taken}: cannot receive there: Address already"
    )
    assert error.endswith("; name an address of this machine and a port that is free\n")


def no_such_name(*asked: object) -> NoReturn:
    raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")


@pytest.mark.parametrize(
    ("command", "flag", "others"),
    [
        ("world", "--peer", ["--listen", FREE, "--key", "KEY"]),
        ("cloud", "--peer", ["--listen", FREE, "--key", "KEY"]),
        ("relay", "--world", ["--world-side", FREE, "--cloud-side", FREE, "--cloud", FREE]),
        ("relay", "--cloud", ["--world-side", FREE, "--cloud-side", FREE, "--world", FREE]),
    ],
)
def test_an_unresolvable_name_is_reported_at_the_start(
    command: str,
    flag: str,
    others: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "key").write_bytes(b"k" * 32)
    (tmp_path / "key").chmod(0o600)
    others = [str(tmp_path / "key") if word == "KEY" else word for word in others]
    look_up = socket.getaddrinfo
    monkeypatch.setattr(
        socket, "getaddrinfo", lambda *a: no_such_name() if a[0] == "nowhere" else look_up(*a)
    )
    assert main([command, *CONFIG, flag, "nowhere:7400", *others]) == 2
    assert capsys.readouterr().err == (
        f"cloudrc: error: {flag} nowhere:7400: nowhere cannot be resolved (Name or service not"
        " known); name a host that has an IPv4 address, or the address itself\n"
    )


@pytest.mark.parametrize(
    ("text", "address"),
    [("127.0.0.1:7400", ("127.0.0.1", 7400)), ("[::1]:7400", ("::1", 7400)), ("[::]:1", ("::", 1))],
)
def test_an_address_of_ipv6_is_in_brackets(text: str, address: tuple[str, int]) -> None:
    assert read_address(text) == address
    assert show_address(address) == text
    with pytest.raises(argparse.ArgumentTypeError, match=r"put an IPv6 address in brackets"):
        read_address("::1:7400")


def test_without_ipv6_all_addresses_are_those_of_ipv4(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*asked: object) -> None:
        raise OSError("Address family not supported by protocol")

    monkeypatch.setattr(socket, "socket", refuse)
    assert read_address("[::]:7400") == ("0.0.0.0", 7400)


def test_a_link_names_a_peer_with_ipv6_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def look_up(name: str, port: None, family: int, kind: int) -> list[tuple[Any, ...]]:
        return [(family, kind, 17, "", ("::5", 0))] if family == socket.AF_INET6 else no_such_name()

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    with pytest.raises(OSError, match="IPv6 addresses alone, and a link is shaped over IPv4"):
        ipv4_addresses("cloud")
    assert resolve_address("--peer", ("cloud", 1), ("::1", 2)) == ("::5", 1)


def test_a_name_with_too_long_a_label_is_refused() -> None:
    with pytest.raises(BadInputError, match=r"cannot be resolved \(not a name"):
        resolve_address("--peer", ("x" * 64 + ".test", 1))


def test_the_peer_is_resolved_once_before_the_loop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The control loop once asked a name server for every datagram, and waited for it."""
    asked: list[object] = []

    def look_up(name: str, *rest: object) -> list[tuple[Any, ...]]:
        asked.append(name)
        return [(socket.AF_INET, socket.SOCK_DGRAM, 17, "", ("127.0.0.9", 0))]

    with monkeypatch.context() as patch:
        patch.setattr(socket, "getaddrinfo", look_up)
        options = argparse.Namespace(listen=("127.0.0.1", 0), peer=("cloud", 7400), route=None)
        peer = _open_peer(options)
    with peer.socket:
        assert (peer.address, asked) == (("127.0.0.9", 7400), ["cloud"])


# Here, too, the socket stays open after the command.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("end", ["world", "cloud"])
def test_an_end_stopped_at_its_start_completes_its_recording(
    end: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first process of a container ignores signals without a handler."""
    build = getattr(assembly, f"build_{end}")

    def stop_and_build(*arguments: Any) -> Any:
        os.kill(os.getpid(), signal.SIGTERM)
        return build(*arguments)

    monkeypatch.setattr(assembly, f"build_{end}", stop_and_build)
    record = tmp_path / "end.mcap"
    (tmp_path / "key").write_bytes(b"k" * 32)
    (tmp_path / "key").chmod(0o644)
    key = ["--key", str(tmp_path / "key")]
    free = [free_port(), "--peer", FREE, "--record", str(record), *key]
    assert main([end, *CONFIG, "--listen", *free]) == 0
    assert record.read_bytes().endswith(MCAP_MAGIC)
    warning = f"cloudrc: warning: everybody can read {tmp_path / 'key'}: chmod 600"
    assert warning in capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("text", "bytes_"),
    [("1Gi", 2**30), ("500M", 5e8), ("1.5Ki", 1536), ("4096", 4096), ("2k", 2e3)],
)
def test_sizes_are_read_as_in_kubernetes(text: str, bytes_: float) -> None:
    assert read_size(text) == bytes_


@pytest.mark.parametrize("text", ["", "1GB", "-1", "1 Gi", "nan"])
def test_other_sizes_are_refused(text: str) -> None:
    with pytest.raises(argparse.ArgumentTypeError, match="such as 500M or 1Gi"):
        read_size(text)
