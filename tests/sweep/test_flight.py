"""A point of a sweep flies without files and gives what `cloudrc run` gives."""

from cloudrc.cli.run import fly
from cloudrc.config.load import load_experiment
from cloudrc.sweep.flight import fly_point, units

SHORT = "mission.steps.count=1", "mission.steps.period_s=1.0", "criteria.settle_m=null"
"""Overrides of `steps` for one second of flight."""


def test_a_point_gives_the_numbers_of_the_report(tmp_path):
    experiment = load_experiment("steps", SHORT)
    report = fly(experiment, "virtual", tmp_path, page=False)
    flown = fly_point(experiment)
    assert (flown["verdict"], flown["failures"], flown["text"]) == ("success", [], "")
    assert flown["records_sha256"] == report["records_sha256"]
    unit_of = units(())
    numbers = {n: {"value": v, "unit": unit_of[n]} for n, v in flown["numbers"].items()}
    assert numbers == report["numbers"]


def test_a_failed_metric_is_reported(tmp_path):
    (tmp_path / "mine.py").write_text("UNIT = '1'\n\n\ndef measure(flight):\n    return 1 / 0\n")
    flown = fly_point(load_experiment("steps", [*SHORT, f"report.metrics=[{tmp_path}/mine.py]"]))
    assert (flown["verdict"], "mine" in flown["numbers"]) == ("success", False)
    assert flown["text"] == "metric mine failed: ZeroDivisionError: division by zero"
