"""report.json and environment.json: their names, absent values, and what they never contain."""

from __future__ import annotations

import getpass
import json
import platform
from pathlib import Path

import pytest

from cloudrc.report.document import Run, clock_offset_document, environment_document, write_json
from cloudrc.report.write import assess
from tests.metrics.conftest import paper

RUN = Run("virtual", "virtual", "0" * 64)


def document() -> dict[str, object]:
    experiment, recording = paper()
    return assess(recording, experiment, RUN).document


def test_names() -> None:
    assert set(document()) == {
        *("schemaVersion", "verdict", "failures", "experiment", "mode", "seed", "shaper"),
        *("config_sha256", "records_sha256", "numbers", "complete", "notes"),
    }


def test_values() -> None:
    report = document()
    assert report["schemaVersion"] == 1
    assert report["verdict"] == "success"
    assert report["failures"] == []
    assert (report["experiment"], report["mode"], report["seed"]) == ("paper", "virtual", 1)
    assert report["shaper"] == "virtual"
    assert report["complete"] is True
    assert all(set(number) == {"value", "unit"} for number in report["numbers"].values())


def test_unknown_values_are_absent() -> None:
    experiment, recording = paper()
    report = assess(recording, experiment, Run("virtual", "virtual")).document
    assert "records_sha256" not in report
    assert "real_time_factor" not in report["numbers"]
    assert "null" not in json.dumps(report)


def test_failures_say_code_text_time_and_place() -> None:
    experiment, recording = paper()
    strict = experiment.criteria.model_copy(update={"time_limit_s": 5.0})
    failed = experiment.model_copy(update={"criteria": strict})
    report = assess(recording, failed, RUN).document
    (failure,) = report["failures"]
    assert set(failure) == {"code", "text", "time", "place"}
    assert failure["code"] == "time_limit_exceeded"
    assert len(failure["place"]) == 3
    assert report["operator_verdict"] == {"verdict": "success", "failures": []}
    assert "the operator's verdict is success. This report's counts." in report["notes"][-1]


def test_the_same_flight_gives_the_same_document() -> None:
    assert json.dumps(document()) == json.dumps(document())


def test_a_clock_offset_has_its_uncertainty() -> None:
    metadata = {"clock_offset_method": "packets", "clock_offset_uncertainty_ns": "1500000"}
    uncertainty = {"value": pytest.approx(0.0015), "unit": "s"}
    assert clock_offset_document(metadata) == {"method": "packets", "uncertainty": uncertainty}
    assert clock_offset_document({"clock_offset_method": "first records"}) == {
        "method": "first records"
    }
    assert clock_offset_document({"clock_offset_method": "same clock"}) is None
    assert clock_offset_document({}) is None


def test_numbers_that_are_not_finite_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="JSON compliant"):
        write_json(tmp_path / "report.json", {"value": float("nan")})


def test_the_environment_names_software_but_no_user_or_host() -> None:
    environment = environment_document()
    assert environment["packages"]["numpy"]
    assert environment["cores"] >= 1
    words = json.dumps(environment).replace('"', " ").split()
    assert getpass.getuser() not in words
    assert platform.node() not in words
