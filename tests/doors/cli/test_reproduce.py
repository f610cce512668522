# SPDX-License-Identifier: Apache-2.0

"""`cloudrc reproduce` writes the table and the figure, and flies what is missing."""

import json

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.studies.reproduce import flights
from cloudrc.studies.reproduce.flights import PaperFlights


def short(link=""):
    """Yield all conditions, with flights of a second."""
    for each in ALL(link):
        yield PaperFlights(*each[:2], [*each.settings, "criteria.time_limit_s=1"], *each[3:])


ALL = flights.conditions


@pytest.fixture
def quick(folder, monkeypatch, one_core):
    monkeypatch.setattr(flights, "conditions", short)
    monkeypatch.setattr(flights, "shown", lambda: load_experiment("hover", SHORT))


SHORT = "criteria.time_limit_s=1", "world.scene=empty"


@pytest.mark.usefixtures("quick")
def test_a_second_call_flies_what_is_missing(folder, call, monkeypatch):
    printed = call("reproduce --seeds 1 -o out")
    assert printed.out.endswith("out/reproduce.pdf\n")
    names = {"json", "md", "pdf", "png", "svg"}
    assert names == {path.suffix[1:] for path in (folder / "out").glob("reproduce.*")}
    document = json.loads((folder / "out/reproduce.json").read_text())
    assert [each["number"] for each in document["statements"]] == [*range(1, 9)]
    same = "cloudrc.studies.reproduce.figure.draw"  # the same figure: not drawn again
    monkeypatch.setattr(same, lambda found: {})
    again = call("reproduce --seeds 1 -o out --link lte")
    assert "seeds 1 to 1: 2 flights" in again.out
    document = json.loads((folder / "out/reproduce.json").read_text())
    assert {each["lte"] for each in document["quantities"]} > {"-"}


@pytest.mark.parametrize(
    ("link", "begin", "part"),
    [
        ("ltee", "--link: no profile named 'ltee'", "did you mean lte?"),
        ("mine.yaml", "--link: mine.yaml: ", "No such file"),
        ("mine.csv", "--link mine.csv: there is no such file; ", "link record"),
        ("bad.csv", "--link: trace ", "bad.csv"),
    ],
)
def test_a_link_that_is_wrong_is_told_once(folder, refused, link, begin, part):
    (folder / "bad.csv").write_text("a,b\n")
    error = refused(f"reproduce --link {link}")
    assert error.startswith(f"cloudrc: error: {begin}")
    assert part in error
