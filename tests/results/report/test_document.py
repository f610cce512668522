# SPDX-License-Identifier: Apache-2.0

"""report.json and environment.json: their keys, absent values, and no names of users."""

import getpass
import json
import platform
from dataclasses import replace

from cloudrc.results.report.document import Run, environment_document
from cloudrc.results.report.write import assess
from tests.results.metrics.conftest import paper

RUN = Run("virtual", "virtual")
NAMES = set(
    "schemaVersion verdict failures experiment mode seed shaper config_sha256 records_sha256 "
    "numbers budget complete notes link_start".split()
)


def document(**criteria):
    experiment, recording = paper()
    changed = experiment.criteria.model_copy(update=criteria)
    return assess(recording, experiment.model_copy(update={"criteria": changed}), RUN).document


def test_names_and_values():
    report = document()
    assert set(report) == NAMES
    expected = {"schemaVersion": 1, "verdict": "success", "experiment": "paper", "seed": 1}
    expected |= {"mode": "virtual", "shaper": "virtual", "failures": []}
    assert expected.items() <= report.items()
    assert (report["complete"], report["notes"]) == (True, [])
    assert all(set(number) == {"value", "unit"} for number in report["numbers"].values())
    # What is unknown is absent.
    assert "real_time_factor" not in report["numbers"]
    torn = assess(replace(paper()[1], lacking="cut short"), paper()[0], RUN).document
    assert set(torn) == NAMES - {"records_sha256"}


def test_failures_say_code_text_time_and_place():
    report = document(time_limit_s=5.0)
    (failure,) = report["failures"]
    assert set(failure) == {"code", "text", "time", "place"}
    assert (failure["code"], len(failure["place"])) == ("time_limit_exceeded", 3)
    assert report["operator_verdict"] == {"verdict": "success", "failures": []}
    assert "verdict was success. The verdict of this report counts." in report["notes"][-1]


def test_the_environment_names_software_but_no_user_or_host():
    environment = environment_document()
    assert environment["packages"]["numpy"]
    assert environment["cores"] >= 1
    assert "physics_steps" not in environment
    assert environment_document("C (compiled by cc)")["physics_steps"] == "C (compiled by cc)"
    words = json.dumps(environment).replace('"', " ").split()
    assert {getpass.getuser(), platform.node()}.isdisjoint(words)
