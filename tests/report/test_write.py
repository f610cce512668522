"""A report is written as far as its packages are installed."""

from __future__ import annotations

import builtins
import json
import sys
from pathlib import Path
from typing import Any

import pytest

from cloudrc.errors import MissingPrerequisiteError
from cloudrc.record.columns import Recording
from cloudrc.report.document import Run
from cloudrc.report.write import write_report
from tests.metrics.conftest import good, paper

RUN = Run("virtual", "virtual", "f" * 64)


def test_without_matplotlib_the_numbers_are_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def refuse(name: str, *args: Any) -> Any:
        if name.partition(".")[0] == "matplotlib":
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return real(name, *args)

    for name in [n for n in sys.modules if n.startswith("cloudrc.report.figures")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(builtins, "__import__", refuse)
    with pytest.raises(MissingPrerequisiteError, match=r"cloudrc\[report\]"):
        write_report(tmp_path, Recording.from_records(*good().ends()), paper()[0], RUN)
    assert json.loads((tmp_path / "report.json").read_text())["schemaVersion"] == 1
    assert not (tmp_path / "report.html").exists()
