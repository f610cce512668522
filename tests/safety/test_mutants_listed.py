"""The page of mutants: it is compared with what mutmut has found, and adds up."""

from __future__ import annotations

import ast
import re

import pytest

from tools.mutants import PACKAGES, PAGE, compare, listed, where

PART = """\
## Guard

Two survive.

| where | mutant | why it makes no difference |
|---|---|---|
| `Guard.begin` | `None` or `1` for `0` (2) | nobody reads it |
| `approach` | `>=` for `>` | both ways give 0 |
"""
ALIVE = [
    "    cloudrc.world.guard.xǁGuardǁbegin__mutmut_1: survived",
    "    cloudrc.world.guard.xǁGuardǁbegin__mutmut_4: survived",
    "    cloudrc.world.guard_rules.x_approach__mutmut_2: survived",
]
DEAD = [
    "    cloudrc.world.guard.xǁGuardǁbegin__mutmut_2: killed",
    "    cloudrc.tunnel.codec.x__overlap__mutmut_2: timeout",
]


def test_a_page_that_lists_what_survives_is_complete() -> None:
    differ, statuses = compare(ALIVE + DEAD, PART)
    assert differ == []
    assert statuses == {"survived": 3, "killed": 1, "timeout": 1}


@pytest.mark.parametrize("status", ["survived", "no tests", "suspicious"])
def test_one_that_is_not_listed_is_named(status: str) -> None:
    (line,) = compare([*ALIVE, f"cloudrc.tunnel.codec.x__overlap__mutmut_3: {status}"], PART)[0]
    assert line.startswith("_overlap (Tunnel): 1 survive, the page lists 0")
    assert "mutmut show cloudrc.tunnel.codec.x__overlap__mutmut_3" in line


def test_one_that_is_listed_and_noticed_is_named() -> None:
    (line,) = compare([*ALIVE[1:], DEAD[0]], PART)[0]
    assert line.startswith("Guard.begin (Guard): 1 survive, the page lists 2")


def test_a_function_that_has_gone_is_named() -> None:
    (line,) = compare(ALIVE[:2], PART)[0]
    assert line == "approach (Guard): the page lists it, it has no mutant"


def test_what_was_not_tried_is_not_judged() -> None:
    untried = [line.replace("survived", "not checked") for line in ALIVE]
    assert compare(untried, PART)[0] == []


def test_a_function_is_told_by_its_class_and_its_package() -> None:
    assert where("cloudrc.cloud.teleop.journal.xǁJournalǁ_put__mutmut_12") == (
        "Journal",
        "Journal._put",
    )
    assert where("cloudrc.tunnel.keys.x_parse__mutmut_1") == ("Tunnel", "parse")
    with pytest.raises(ValueError, match="has no section for it"):
        where("cloudrc.link.model.x_parse__mutmut_1")


def test_every_function_of_the_page_is_there() -> None:
    there = set()
    for section, package in PACKAGES.items():
        for path in (PAGE.parents[2] / package.replace(".", "/")).glob("*.py"):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                there.add((section, getattr(node, "name", "")))
                if isinstance(node, ast.ClassDef):
                    methods = [part for part in node.body if isinstance(part, ast.FunctionDef)]
                    there.update((section, f"{node.name}.{part.name}") for part in methods)
    assert set(listed(PAGE.read_text(encoding="utf-8"))) - there == set()


@pytest.mark.parametrize("section", PACKAGES)
def test_the_rows_of_the_page_add_up(section: str) -> None:
    page = PAGE.read_text(encoding="utf-8")
    text = page.split(f"## {section}\n")[1].split("## ")[0]
    (told,) = re.findall(r"(\d+)\s+survive\.", text)
    assert sum(n for (of, _), n in listed(page).items() if of == section) == int(told)
    rows = sum(line.startswith("| ") for line in text.splitlines()) - 1
    assert rows == len(re.findall(r"^\| `[\w.]+` \| ", text, re.MULTILINE))
