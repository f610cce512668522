"""`make nightly` reaches every long number of the promises: each is in it by name."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
_, _, REST = MAKEFILE.partition("# The long numbers,")
LIST, _, RECIPE = REST.partition("\nnightly:")
RECIPE = RECIPE.partition("\n\n")[0].replace("\\\n\t\t", "")
TESTS = re.findall(r"^#   .+?  (test_\w+)$", LIST, re.MULTILINE)
NUMBERS = (
    "10^7 hostile datagrams, coverage-guided",
    "10^6 hostile datagrams, by chance",
    "every bit of 1,000 datagrams flipped",
    "every sequence of 6 of 16 counters",
    "two clouds, interleaved to depth 10",
    "10^6 cases of hypothesis at the guard",
    "10^6 commands and readings of the guard",
    "silent from 200 instants on, 1.5 m/s",
    "silent from 200 instants on, uncapped",
    "killed at 200 instants, a new process",
    "blackouts at 24 instants, each way",
    "1,000 requests a second for 20 s",
)
LINES = (
    "-n auto -m 'not process and not e2e and not netem'",
    "pytest -m process",
    "faults run --all --real --document docs/safety/faults-real.md",
    "CLOUDRC_FLOOD_SECONDS=600 $(bin)/cloudrc faults run garbage-flood --real",
    "faults fuzz --clean --seeds 600 --jobs $(JOBS) --document docs/safety/clean.md ",
    "faults fuzz --adversarial --seeds 5000 --jobs $(JOBS) --document docs/safety/adversary.md ",
    "faults fuzz --seeds 30000 --jobs $(JOBS) --document docs/safety/search.md ",
    "$(MAKE) mutants",
    "$(MAKE) test-netem-full",
    "$(MAKE) e2e-full",
)


@pytest.mark.parametrize("number", NUMBERS)
def test_a_long_number_is_named(number: str) -> None:
    assert number in LIST


@pytest.mark.parametrize("line", LINES)
def test_what_runs_it_is_a_line_of_it(line: str) -> None:
    assert line in RECIPE


def test_every_test_that_it_names_is_there_once() -> None:
    assert len(TESTS) == len(NUMBERS)
    texts = [path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")]
    there = [name for text in texts for name in re.findall(r"^def (test_\w+)", text, re.MULTILINE)]
    assert {name: there.count(name) for name in TESTS} == dict.fromkeys(TESTS, 1)


def test_a_short_search_does_not_overwrite_what_a_long_one_has_shown() -> None:
    short = MAKEFILE.partition("\nfaults:")[2].partition("\n\n")[0].replace("\\\n\t\t", "")
    searches = [line for line in short.splitlines() if "faults fuzz" in line]
    assert len(searches) == 2
    assert all("--document build/" in line for line in searches)
    assert "docs/safety/faults.md" in short
    ci = (ROOT / ".ci/run").read_text(encoding="utf-8")
    assert "faults fuzz" not in ci, "it searches by make faults alone"


def test_the_slices_that_it_tells_of_are_the_whole_search() -> None:
    flown = re.findall(r"^#   cloudrc faults fuzz --first (\d+) --seeds (\d+)", LIST, re.MULTILINE)
    ends = [int(first) + int(count) for first, count in flown]
    assert [int(first) for first, _ in flown] == [1, *ends[:-1]]
    assert f"faults fuzz --seeds {ends[-1] - 1} " in RECIPE
