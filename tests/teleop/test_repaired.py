"""A teleop that finds its journal torn says so in its metrics, from its start on."""

from __future__ import annotations

import argparse
import socket
from pathlib import Path
from typing import Any

import pytest

from cloudrc.assembly import build_plan
from cloudrc.cli import teleop
from cloudrc.cli.main import main
from cloudrc.cli.runtime import open_exporter
from cloudrc.config.load import load_experiment
from cloudrc.config.shipped import FOLDERS
from cloudrc.drivers.exporter import Exporter
from cloudrc.drivers.realtime import free_ports
from cloudrc.teleop.journal import Journal
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import Order

HOVER = FOLDERS["experiment"] / "hover.yaml"


@pytest.fixture
def journal(tmp_path: Path) -> Path:
    """Of a mission that was ordered, and of nothing else."""
    path = tmp_path / "journal"
    with Journal(path) as kept:
        service = MissionService(1.0, kept.append, salt=bytes(16))
        service.create(Order(build_plan(load_experiment(str(HOVER)))), 0)
        assert len(kept.path.read_bytes()) > 100
    return path


# Its sockets are closed by the end of the process, which here goes on.
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
@pytest.mark.usefixtures("handlers")
@pytest.mark.parametrize(("cut", "repaired"), [(0, 0), (3, 1)])
def test_a_torn_journal_is_counted_in_the_metrics(
    cut: int, repaired: int, journal: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal.write_bytes(journal.read_bytes()[: -cut or None])
    exporters: list[Exporter] = []

    def opened(options: argparse.Namespace, role: str) -> Exporter:
        exporter = open_exporter(options, role)
        assert exporter is not None
        exporters.append(exporter)
        return exporter

    def serve(*machine: Any, **rest: Any) -> None:
        """In place of its loop: it has started, and that is all."""

    monkeypatch.setattr(teleop, "open_exporter", opened)
    monkeypatch.setattr("cloudrc.drivers.teleop.serve_teleop", serve)
    (port,) = free_ports(1, socket.SOCK_STREAM)
    words = ["--socket", str(tmp_path / "sockets"), "--journal", str(journal)]
    metrics = ["--metrics", f"127.0.0.1:{port}"]
    assert main(["teleop", "--config", str(HOVER), *words, *metrics]) == 0
    (exporter,) = exporters
    lines = exporter.text().splitlines()
    exporter.close()
    assert f"cloudrc_journal_repaired_total {repaired:.1f}" in lines
