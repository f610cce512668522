"""The fault suite of the cluster: one fault, and all of `cloudrc faults run --all --cluster`."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from cloudrc.faults.scenario import scenarios
from tests.e2e.conftest import NAME, NAMESPACE, cloudrc

WHERE = ("--cluster", "-n", NAMESPACE, "--release", NAME, "-o", "json")


def survived(note: Callable[[str], None], *words: str, timeout: float) -> set[str]:
    """Run faults; the names of those that came out well, each with a line in the summary."""
    done = cloudrc("faults", "run", *words, *WHERE, timeout=timeout)
    if "--all" in words and (evidence := os.environ.get("CLOUDRC_EVIDENCE")):
        (Path(evidence) / "faults-cluster.json").write_text(done.stdout, encoding="utf-8")
    results = json.loads(done.stdout)["faults"]
    for result in results:
        note(f"{result['id']} {result['name']}: {result['result']}, {result['seconds']:.0f} s")
    missed = [
        f"{result['id']}: {result['reason']} {check['text']}: {check['measured']}"
        for result in results
        for check in result["checks"] or [{"passed": False, "text": "no check", "measured": ""}]
        if not check["passed"] or result["reason"]
    ]
    assert missed == []
    assert done.returncode == 0, done.stderr
    return {result["name"] for result in results}


@pytest.mark.full
def test_a_partition_is_survived(installed: None, note: Callable[[str], None]) -> None:
    assert survived(note, "partition", timeout=300.0) == {"partition"}


@pytest.mark.full
def test_every_fault_is_survived(installed: None, note: Callable[[str], None]) -> None:
    names = {each.name for each in scenarios("cluster")}
    assert survived(note, "--all", timeout=2400.0) == names
