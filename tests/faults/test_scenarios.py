"""The named faults: each passes, one seed is one run, and the results are told."""

import json
import pickle
import re
from dataclasses import replace
from functools import partial

import pytest

from cloudrc.cli import faults as command
from cloudrc.cli.main import main
from cloudrc.faults.scenarios import SCENARIOS, find
from tests.conftest import nightly

NUMBERS = (*range(1, 14), 15, 17, *range(20, 26), 27, 28, 40)
QUICK = ("F6", "F13", "F17", "F40")


@pytest.mark.parametrize(
    "scenario",
    [
        *(each for each in SCENARIOS if each.id in QUICK),
        *nightly(*(each for each in SCENARIOS if each.id not in QUICK)),
    ],
    ids=lambda each: each.name,
)
def test_a_fault_passes_its_checks(scenario):
    outcome = scenario.run(2)
    assert [check.show() for check in outcome.checks if not check.passed] == []
    assert outcome.passed, outcome.error


@pytest.mark.parametrize(
    ("name", "broken", "value", "said"),
    [
        ("F13", "cloudrc.world.guard.state.SETTLE_NS", 3 * 10**9, "TRACK again after its start"),
        ("F40", "cloudrc.world.endpoint.REAL_TIME_FACTOR_MIN", 0.0, "times that world reports"),
        ("F13", "cloudrc.faults.invariants.HIGH", (1.2, 1.2, 1.2), "breaches of an invariant"),
    ],
)
def test_a_check_fails_if_its_promise_is_broken(name, broken, value, said, monkeypatch):
    monkeypatch.setattr(broken, value)
    failed = [check.text for check in find(name).run(1).checks if not check.passed]
    assert any(said in text for text in failed)


def test_the_command_prints_json(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "F17").mkdir()  # a folder is no schedule
    assert main("faults run F17 -o json".split()) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["schemaVersion"], printed["faults"][0]["result"]) == (1, "passed")
    assert {check["unit"] for check in printed["faults"][0]["checks"]} == {"", "m", "m/s", "yes"}
    assert pickle.dumps(command._run("F27", 1)), "a result comes back from another process"


def test_a_failed_check_ends_in_exit_code_1(monkeypatch, capsys):
    def run(outcome, seed, number):
        outcome.same("collisions", 2.0 * (number == 1), 0)
        if number == 2:
            raise ValueError("broken")

    fakes = [replace(each, inject=partial(run, number=each.number)) for each in SCENARIOS]
    monkeypatch.setattr("cloudrc.faults.scenarios.SCENARIOS", fakes)
    assert main(["faults", "run", "--all"]) == 1
    out = capsys.readouterr().out
    for said in ("x collisions: 2 (0)", "22 of 24 passed, 2 failed", "ValueError: broken"):
        assert said in out


def test_the_list_names_every_fault(capsys):
    assert main(["faults", "list"]) == 0
    listed = re.findall(r"^F(\d+) +([\w-]+)", capsys.readouterr().out, re.MULTILINE)
    assert tuple(int(number) for number, _ in listed) == NUMBERS
    assert len({name for _, name in listed}) == len(NUMBERS)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "the following arguments are required: ACTION"),
        ("run F1 --seed 9007199254740992", "argument --seed: '9007199254740992' is not a whole"),
        ("run /dev/null", "/dev/null: not a regular file"),
        ("run cloud-kiled", "no fault 'cloud-kiled'; there are: F1 short-blackout, F2 "),
        ("run cloud-kiled", "; did you mean cloud-killed?"),
        ("search --minutes nan", "'nan' is not a number of minutes"),
        ("search --store /dev/null/found", "cannot be written"),
    ],
)
def test_bad_input_is_told_in_one_line(words, said, capsys):
    assert main(["faults", *words.split()]) == 2
    out, err = capsys.readouterr()
    assert said in err
    assert (out, err.count("\n")) == ("", 1)
