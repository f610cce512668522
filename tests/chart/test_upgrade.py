# SPDX-License-Identifier: Apache-2.0

"""Values of earlier charts: `helm upgrade` takes them, reused as a whole and over new defaults."""

import tarfile

import pytest
import yaml

from tests.chart.conftest import ROOT, notes, of_kind, render

PACKED = sorted((ROOT / "tests" / "fixtures" / "charts").glob("*.tgz"))
each_chart = pytest.mark.parametrize("path", PACKED, ids=lambda path: path.stem)


def defaults_of(path):
    with tarfile.open(path) as chart:
        return yaml.safe_load(chart.extractfile("cloudrc/values.yaml"))


def but_secrets(objects):
    return [thing for thing in objects if thing["kind"] != "Secret"]


@each_chart
def test_reused_values_of_an_earlier_chart_give_todays_objects(path):
    assert but_secrets(render(reused=defaults_of(path))) == but_secrets(render())


GONE = """
world: {epochs: {a: 1}}
experiment:
  world: {plant: {thrust_factor: 0.9, mass_factor: 1.1}}
  criteria: {contact: true}
"""


def test_values_that_have_gone_are_named_and_reach_no_pod():
    said = notes(GONE, upgrade=True)
    for path in ("world.epochs", "criteria.contact", "plant.thrust_factor"):
        assert f"{path}: " in said
    data = of_kind(render(GONE, only="templates/shared/"), "ConfigMap")["experiment"]["data"][
        "experiment.yaml"
    ]
    assert yaml.safe_load(data) == {"world": {"plant": {"mass_factor": 1.1}}, "criteria": {}}
    assert "no effect" not in notes({})


def test_a_default_that_has_gone_is_not_named():
    (first,) = (path for path in PACKED if "guests" in path.name)
    assert "no effect" not in notes(reused=defaults_of(first), upgrade=True)
