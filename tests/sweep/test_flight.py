"""A point of a sweep flies without files."""

from cloudrc.config.load import load_experiment
from cloudrc.sweep.flight import fly_point

SHORT = "mission.steps.count=1", "mission.steps.period_s=1.0", "criteria.settle_m=null"
"""Overrides of `steps` for one second of flight."""


def test_a_failed_metric_is_reported(tmp_path):
    (tmp_path / "mine.py").write_text("UNIT = '1'\n\n\ndef measure(flight):\n    return 1 / 0\n")
    flown = fly_point(load_experiment("steps", [*SHORT, f"report.metrics=[{tmp_path}/mine.py]"]))
    assert (flown["verdict"], "mine" in flown["numbers"]) == ("success", False)
    assert flown["text"] == "metric mine failed: ZeroDivisionError: division by zero"
