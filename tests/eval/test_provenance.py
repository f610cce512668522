"""An evaluation says how it was made, and how to cite it."""

import sys
from pathlib import Path

import gymnasium
import yaml

from cloudrc.eval.provenance import CITE, provenance
from cloudrc.eval.setup import EvalSetup

FACTS = yaml.safe_load((Path(__file__).parents[2] / "CITATION.cff").read_text())


def test_the_sentence_to_cite_has_the_facts_of_the_citation_file():
    (paper,) = FACTS["references"]
    people = [each["family-names"] for each in paper["authors"]]
    words = (FACTS["authors"][0]["name"], FACTS["title"], FACTS["version"], paper["title"])
    for each in (*words, *people, paper["conference"]["name"], paper["url"]):
        assert each in CITE


def test_versions_are_those_of_loaded_packages_and_of_the_environments_own(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "torch", raising=False)
    made = provenance(EvalSetup("pytest.x:X-v0", "law.py", link="lte"), "cloudrc eval")
    assert made["versions"]["gymnasium"] == gymnasium.__version__
    assert {"python", "cloudrc", "numpy", "mujoco", "pytest"} <= made["versions"].keys()
    assert "torch" not in made["versions"]
    assert made["profile"]["uplink"]["rate_kbit"] == 10_000
    assert made["profile"]["downlink"]["delay_ms"] == 20
