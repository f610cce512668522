# SPDX-License-Identifier: Apache-2.0

"""What others read about cloudrc has the form that they ask for, and one source of authors."""

import json
import re
from copy import deepcopy
from pathlib import Path

import pytest
import yaml

from tools import metadata

jsonschema = pytest.importorskip("jsonschema", reason="comes with kubernetes-validate, extra dev")

ROOT = Path(__file__).resolve().parents[1]
PROJECT = {
    "name": "cloudrc",
    "description": "a testbed",
    "requires-python": ">=3.11",
    "dependencies": ["numpy>=1.26", "prometheus-client>=0.20"],
    "scripts": {"cloudrc": "cloudrc.doors.cli.main:main"},
}
ADA = {
    "given-names": "Ada",
    "family-names": "Lovelace",
    "orcid": "https://orcid.org/0000-0002-1825-0097",
    "affiliation": "University of London",
    "email": "ada@example.org",
}


def annotations():
    """Read the chart's annotations; those of several lines are YAML in a text."""
    found = yaml.safe_load((ROOT / "charts" / "cloudrc" / "Chart.yaml").read_text())["annotations"]
    return {key: yaml.safe_load(text) if "\n" in text else text for key, text in found.items()}


def read(name):
    return yaml.safe_load((ROOT / name).read_text())


@pytest.mark.parametrize(
    ("schema", "content"),
    [
        ("zenodo", read(".zenodo.json")),
        ("codemeta", read("codemeta.json")),
        ("recipe", read("conda/recipe.yaml")),
        ("artifacthub", annotations()),
    ],
)
def test_a_file_for_others_has_the_form_that_they_ask_for(schema, content):
    path = ROOT / "tests" / "fixtures" / "metadata" / f"{schema}.json"
    schema = jsonschema.Draft7Validator(json.loads(path.read_text()))
    schema.validate(content)
    for key in schema.schema["required"]:
        assert not schema.is_valid({k: v for k, v in content.items() if k != key})


def test_an_author_of_citation_cff_is_in_every_file():
    cff = deepcopy(read("CITATION.cff")) | {"authors": [ADA, {"name": "Engine Lab"}]}
    number = "0000-0002-1825-0097"
    assert metadata.zenodo(cff, PROJECT)["creators"] == [
        {"name": "Lovelace, Ada", "affiliation": "University of London", "orcid": number},
        {"name": "Engine Lab"},
    ]
    person, group = metadata.codemeta(cff, PROJECT)["author"]
    assert (person["@id"], person["familyName"]) == (ADA["orcid"], "Lovelace")
    assert group == {"@type": "Organization", "name": "Engine Lab"}
    assert metadata.paper(cff["authors"]) == {
        "authors": [
            {"name": "Ada Lovelace", "orcid": number, "affiliation": "1"},
            {"name": "Engine Lab", "affiliation": "2"},
        ],
        "affiliations": [
            {"index": 1, "name": "University of London"},
            {"index": 2, "name": "Independent Researcher"},
        ],
    }


def test_the_recipe_asks_for_what_pyproject_asks_for():
    recipe = metadata.recipe(read("CITATION.cff"), PROJECT)
    run = recipe["requirements"]["run"]
    assert run == ["python >=3.11", "numpy >=1.26", "prometheus_client >=0.20"]
    assert recipe["build"]["python"]["entry_points"] == ["cloudrc = cloudrc.doors.cli.main:main"]


def test_the_paper_cites_what_its_bibliography_has():
    text = (ROOT / "paper" / "paper.md").read_text()
    keys = set(re.findall(r"^@\w+\{(\w+),", (ROOT / "paper" / "paper.bib").read_text(), re.M))
    assert set(re.findall(r"@(\w+)", text.partition("# Summary")[2])) == keys
    assert set(re.findall(r"^# (.*)$", text, re.M)) >= {
        "Summary",
        "Statement of need",
        "State of the field",
    }
    assert 750 <= len(text.partition("# Summary")[2].split()) <= 1750
