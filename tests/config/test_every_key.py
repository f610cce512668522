# SPDX-License-Identifier: Apache-2.0

"""Every key of the schema can be reached: a wrong type is refused there."""

import json

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.config.schema import Experiment
from tests.config.conftest import refused
from tests.support.keys import forms_of

FORMS = forms_of(Experiment)
ONE_WAY = [key for key in FORMS if "downlink" not in key]  # uplink and downlink are alike


@pytest.mark.usefixtures("files_are_read_once")
def test_wrong_type_is_refused():
    for key in ONE_WAY:
        base = "steps" if key == "mission" or key.startswith("mission.steps") else "paper"
        takes_numbers = {"number", "integer"} & {form["type"] for form in FORMS[key]}
        text = refused(base, f"{key}={json.dumps([['a']] if takes_numbers else 3)}")
        assert f"--set: {key}" in text
        assert "must be" in text, key


def test_every_key_is_described_and_dumped():
    text = dump(load_experiment("paper"))
    optional = "mission.steps mission.carrot .loss. .changes.0 .blackouts.0 .traffic.0".split()
    optional += [
        "repeat_s",
        "rate_trace",
        ".radio",
        "link.start_s",
        "cloud.answers",
        "faults",
        "camera",
        "mission.follow",
        "world.scan",
        "cloud.perception",
    ]  # left out where they have their default
    for key in FORMS:
        assert any(part in key for part in optional) or f"{key.rpartition('.')[2]}:" in text, key
