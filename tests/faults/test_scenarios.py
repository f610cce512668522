"""Every fault of the table has a scenario that passes, and one seed is one run."""

from __future__ import annotations

import hashlib
import json
import re
import xml.etree.ElementTree as Xml
from pathlib import Path

import pytest

from cloudrc import __version__
from cloudrc.cli.faults import SEED_MAX, seed
from cloudrc.cli.main import main
from cloudrc.cli.parser import COUNT_MAX
from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError
from cloudrc.faults import asks, document
from cloudrc.faults.document import Result
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Check, Outcome, Scenario, called, find, scenarios

FAULTS = [*range(1, 36), *range(37, 41)]
QUICK = ("short-blackout", "cloud-killed", "forged-command", "bad-configuration")
SHARED = scenarios("virtual")


def test_every_fault_of_the_table_has_a_scenario() -> None:
    assert {each.number for each in scenarios()} == set(FAULTS)
    names = [(each.name, each.mode) for each in scenarios()]
    assert len(names) == len(set(names))


def assert_survived(scenario: Scenario, seed: int) -> None:
    """Every check passes, and every metric that the user is told of is among them."""
    outcome = scenario.run(seed)
    assert [check.show() for check in outcome.checks if not check.passed] == []
    assert outcome.checks
    asked = {name for check in outcome.checks for name in re.findall(r"metric (\w+)", check.text)}
    named = set(re.findall(r"cloudrc_(\w+)", scenario.shows))
    assert named <= asked
    assert named or "no metric" in scenario.shows


@pytest.mark.parametrize("name", QUICK)
def test_a_fault_is_survived(name: str) -> None:
    assert_survived(find(name, "virtual"), 1)


@pytest.mark.full
@pytest.mark.parametrize("scenario", SHARED, ids=lambda each: each.name)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_every_fault_is_survived(scenario: Scenario, seed: int) -> None:
    assert_survived(scenario, seed)


@pytest.mark.promise("one-seed-one-run")
@pytest.mark.parametrize("name", ["F40", "F16"], ids=["one flight", "three flights"])
def test_one_seed_is_one_run(name: str) -> None:
    scenario = find(name, "virtual")
    first, second, other = scenario.run(3), scenario.run(3), scenario.run(4)
    assert first.sha256 == second.sha256 != other.sha256
    assert first.checks == second.checks


def test_an_unknown_fault_is_bad_input() -> None:
    with pytest.raises(BadInputError, match="no fault 'F99' in mode virtual; there are: F1 "):
        find("F99", "virtual")
    with pytest.raises(BadInputError, match=r"; did you mean cloud-killed\?$"):
        find("cloud-kiled", "virtual")


def test_a_number_stands_for_all_its_faults() -> None:
    assert [each.name for each in called("f31", "real")] == ["slow-scrapers", "fast-scrapers"]


@pytest.mark.parametrize(
    ("check", "passed"),
    [
        (Check("", 1.0, "<=", 1.0), True),
        (Check("", 1.1, "<=", 1.0), False),
        (Check("", 0.9, ">=", 1.0), False),
        (Check("", 1.0, "==", 1.0), True),
        (Check("", float("nan"), "<=", 1.0), False),
        (Check("", float("inf"), ">=", 1.0), False),
    ],
)
def test_what_is_not_measured_has_not_passed(check: Check, passed: bool) -> None:
    assert check.passed is passed


def test_the_hash_is_over_all_flights() -> None:
    one, two = Outcome(), Outcome()
    for outcome, hashes in ((one, "ab"), (two, "cb")):
        for sha256 in hashes:
            outcome.flown(sha256)
    assert one.sha256 != two.sha256
    one.add(Outcome())
    assert one.sha256 == hashlib.sha256(b"a b").hexdigest()


@pytest.mark.parametrize("honest", [False, True])
def test_no_collision_is_counted_where_nobody_looks_for_one(honest: bool) -> None:
    outcome = Outcome()
    asks.safe(outcome, Flight(honest=honest).fly(0.1))
    assert ("collisions" in [check.text for check in outcome.checks]) is honest


def good() -> Outcome:
    outcome = Outcome(sha256="ab" * 32)
    outcome.most("HOLD after", 0.252, 0.252, "s")
    outcome.most("HOLD after", 0.1, 0.252, "s")
    outcome.true("mission done", True)
    return outcome


def results() -> list[Result]:
    bad, none = Outcome(), Outcome(skipped="not here")
    bad.same("collisions", 2, 0)
    scenario = find("F13", "virtual")
    return [
        Result(scenario, good(), 1.0),
        Result(scenario, bad, 2.0),
        Result(scenario, none, 0.0),
        Result(scenario, Outcome(), 0.0, "ValueError: broken"),
    ]


def test_results_as_junit() -> None:
    suite = Xml.fromstring(document.as_junit(results(), 7))
    assert suite.attrib["failures"] == "2"
    assert suite.attrib["skipped"] == "1"
    failures = [case.find("failure") for case in suite]
    texts = ["" if failure is None else failure.attrib["message"] for failure in failures]
    assert texts == ["", "collisions: 2 (0)", "", "ValueError: broken"]


def test_results_as_a_table_show_the_worst_of_each_check() -> None:
    text = document.as_markdown(results(), 7, "virtual")
    assert "HOLD after: 0.252 s (<= 0.252), 2 times" in text
    assert "mission done: yes" in text
    assert f"Seed 7, cloudrc {__version__}: 1 of 3 passed, 1 not run.\n" in text
    assert [line.rsplit(" | ", 1)[1] for line in text.splitlines() if line.startswith("| F13")] == [
        "3 of 3 passed |",
        "0 of 1 passed |",
        "not here |",
        "0 of 0 passed |",
    ]


@pytest.mark.parametrize(("flag", "title"), [("--real", "with real"), ("--cluster", "Kubernetes")])
def test_each_mode_writes_a_page_of_its_own(
    flag: str, title: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from cloudrc.cli import faults

    monkeypatch.setattr(faults, "_look_for_release", lambda options: None)
    monkeypatch.setattr(faults, "_run", lambda which: Result(find(*which[:2]), good(), 1.0))
    page = tmp_path / "page.md"
    assert main(["faults", "run", "--all", flag, f"--document={page}"]) == 0
    text, names = page.read_text(), [f"{s.id} {s.name}" for s in scenarios(flag[2:])]  # type: ignore[arg-type]
    assert title in text.splitlines()[0]
    assert f"{len(names)} of {len(names)} passed.\n" in text
    assert [row.split(" | ")[0][2:] for row in text.splitlines() if row.startswith("| F")] == names


def test_the_command_prints_json_and_exits_by_the_checks(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    junit = tmp_path / "faults.xml"
    assert main(["faults", "run", "F37", "-o", "json", "--junit", str(junit)]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["schemaVersion"] == 1
    assert printed["faults"][0]["result"] == "passed"
    checks = {check["text"]: check["unit"] for check in printed["faults"][0]["checks"]}
    assert checks["exit codes other than 2"] == ""
    assert "yes" in checks.values()
    assert Xml.parse(junit).getroot().attrib["tests"] == "1"


def test_a_failed_check_ends_in_exit_code_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from cloudrc.cli import faults

    monkeypatch.setattr(faults, "_run", lambda which: results()[1])
    assert main(["faults", "run", "F13"]) == 1
    assert "collisions: 2 (0)" in capsys.readouterr().out


def test_the_list_names_every_fault(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["faults", "list"]) == 0
    listed = re.findall(r"^(F\d+) ", capsys.readouterr().out, re.MULTILINE)
    assert set(listed) == {f"F{n}" for n in FAULTS}


def test_without_a_name_or_an_action_it_says_what_is_missing(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["faults"]) == 2
    assert main(["faults", "run"]) == 2
    assert main(["faults", "run", "nothing"]) == 2
    assert "there are: F1 short-blackout" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("run F31", 2, "try: cloudrc faults run slow-scrapers --real"),
        ("run F12 --real", 2, "try: cloudrc faults run jitter"),
        ("run F37 --seed -1", 2, "'-1' is not a whole number"),
        ("run F37 --seed 1e9", 2, "'1e9' is not a whole number"),
        ("run F1 --seed 9007199254740992", 2, "argument --seed: '9007199254740992' is not a whole"),
        ("fuzz --first 9223372036854675807 --seeds 3", 2, "--first: '9223372036854675807' is not"),
        ("fuzz --first -5 --seeds 1", 2, "'-5' is not a whole number"),
        ("run F37 --junit none/x.xml", 2, "this file cannot be written"),
        ("run F37 --document /", 2, "this file cannot be written"),
        ("run F37 --document page.md", 2, "a page of all faults: give --all instead of a name"),
        ("fuzz --seeds 1 --document none/x.md", 2, "this file cannot be written"),
        ("run F13 --real -n lab", 2, "select a release in a cluster: add --cluster"),
        ("run --all --cluster", 3, "no cluster is configured"),
        ("run F13 --cluster", 3, "no cluster is configured"),
    ],
)
def test_what_cannot_be_done_is_said_at_once_and_in_one_line(
    words: str,
    code: int,
    said: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("KUBECONFIG", "/nowhere/config")
    monkeypatch.setattr("kubernetes.config.kube_config.KUBE_CONFIG_DEFAULT_LOCATION", "/nowhere/c")
    assert main(["faults", *words.split()]) == code
    out, err = capsys.readouterr()
    assert said in err
    assert (out, err.count("\n")) == ("", 1)


def test_an_experiment_accepts_the_last_possible_seed() -> None:
    last = SEED_MAX + COUNT_MAX - 1
    assert load_experiment("paper", [f"seed={last}"]).seed == last
    assert seed(str(SEED_MAX)) == SEED_MAX
