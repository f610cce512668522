# SPDX-License-Identifier: Apache-2.0

"""Each statement of the paper is judged by the numbers of the flights."""

import json
from pathlib import Path

import pytest

from cloudrc.studies.reproduce.flights import HALVED, LINKS, conditions
from cloudrc.studies.reproduce.statements import STATEMENTS
from cloudrc.studies.reproduce.table import CAPTION, as_markdown, as_text, describe, summary
from tests.support.sweeps import flown

ROOT = Path(__file__).resolve().parents[3]
PAGE, README = ROOT / "docs" / "reproduce.md", ROOT / "README.md"
NUMBERS = {
    "waypoints_reached": 7.0,
    "tracking_rms_measured": 1.9,
    "tracking_rms_estimated": 1.8,
    "prediction_error_rms": 0.04,
    "min_clearance": 0.15,
    "obstacle_contacts": 0.0,
    "touch_speed": 0.12,
    "steady_contact_force": 0.2,
}
MEASURED = {
    "round_trip": [[0.1, 0.04]],
    "samples_sd": 0.033,
    "estimate_sd": 0.001,
    "peak": [0.8, 6.0, 0.8],
    "fallen": [None, 3.0, None],
    "left": [0.09, 0.4],
}


def rows(seeds=2, only=lambda point: True, measured=None, **numbers):
    """Return rows of all conditions; those whose point is `only` have other numbers."""
    found = []
    for each in conditions():
        delay, jitter = LINKS.get(each.column, (45.0, 25.0))
        known = {**MEASURED, "one_way": [[delay * 1e-3, jitter * 1e-3]]}
        own = {"steady_error_x": 0.0325 if each.hover == "0.10" else 7e-5} if each.hover else {}
        if only(each.point):
            known, own = {**known, **(measured or {})}, {**own, **numbers}
        row = {**flown(**{**NUMBERS, **own}), "point": each.point, "measured": known}
        found += [{**row, "seed": seed} for seed in range(1, seeds + 1)]
    return found


def judged(**changed):
    return {each["number"]: each["reproduced"] for each in describe(rows(**changed))["statements"]}


def in_p3(point):
    return point["column"] == "P3" and not point["hover"]


ALL_BUT_6 = {each.number: each.number != 6 for each in STATEMENTS}


def test_all_statements_but_the_settled_error_hold():
    assert judged() == ALL_BUT_6


@pytest.mark.parametrize(
    ("statement", "changed"),
    [
        (1, {"measured": {"one_way": [[0.08, 0.04]]}}),
        (2, {"measured": {"estimate_sd": 0.04}}),
        (3, {"waypoints_reached": 6.0}),
        (4, {"tracking_rms_estimated": 2.0}),
        (5, {"measured": {"fallen": [None, None, None]}}),
        (7, {"obstacle_contacts": 1.0}),
    ],
)
def test_a_flight_in_which_a_statement_does_not_hold_counts(statement, changed):
    assert judged(only=in_p3, **changed) == {**ALL_BUT_6, statement: False}


def test_the_settled_error_holds_only_below_a_millimetre():
    assert judged(measured={"left": [5e-4]}, steady_error_x=5e-4)[6]
    assert not judged(measured={"left": [5e-4]}, steady_error_x=2e-3)[6]


def test_flights_that_failed_reproduce_nothing():
    failed = [{**row, "numbers": {}, "verdict": "failure"} for row in rows()]
    for row in failed:
        del row["measured"]
    found = describe(failed)
    assert not any(each["reproduced"] for each in found["statements"])
    assert "3  all waypoints are reached: no" in as_text(found)


def test_the_table_has_both_orders_where_they_differ():
    document = describe(rows(only=lambda p: p["order"] == "newest", touch_speed=0.1234))
    json.dumps(document)
    shown = {(each["quantity"], each["order"]): each for each in document["quantities"]}
    assert shown["one way, offered [ms]", "both"]["P2"] == "45±25"
    assert shown["round trip, offered [ms]", "both"][HALVED] == "20±10, 45±25, 70±40"
    assert shown["one way, measured [ms]", "both"]["P3"] == "70±40"
    assert shown["speed of the touch [m/s]", "arrival"]["P1"] == "0.120"
    assert shown["speed of the touch [m/s]", "newest"]["P1"] == "0.123"
    assert len(document["flights"]) == 2 * len([*conditions()])


def test_a_number_that_is_not_of_the_published_order_alone_says_so():
    found = {each["number"]: each["found"] for each in describe(rows())["statements"]}
    assert found[3] == "112/112 waypoints (both orders)"
    assert found[6].startswith("32.50 mm in a hover (newest), 0.07 mm with a higher")
    assert found[6].count("(newest)") == 2
    assert found[7].endswith("touched in 0/16 flights (both orders)")


@pytest.mark.parametrize(
    ("fallen", "found"),
    [
        ([None, 3.0, None], "2/6 waypoints: all but the first and the last"),
        ([3.0, 3.0, None], "4/6 waypoints"),
        ([None, 3.0, 3.0], "4/6 waypoints"),
        ([3.0, None, 3.0], "4/6 waypoints"),
        ([None, None, None], "0/6 waypoints"),
    ],
)
def test_the_waypoints_at_which_the_error_falls_are_told(fallen, found):
    statements = describe(rows(measured={"fallen": fallen}))["statements"]
    assert statements[4]["found"].endswith(f" s, at {found}" if any(fallen) else f", at {found}")


def test_the_pages_have_the_heads_of_this_version():
    head = summary(describe(rows()), ())
    assert f"{head}\n| 1 |" in PAGE.read_text()
    assert f"{head}\n| 2 |" in README.read_text()
    assert f"\n{CAPTION}\n" in PAGE.read_text()


def test_the_statements_can_be_shown_alone():
    document = describe(rows())
    lines = summary(document, (3, 6)).splitlines()
    assert [line.split(" | ")[0] for line in lines[2:]] == ["| 3", "| 6"]
    assert summary(document) in as_markdown(document)


def test_a_trace_of_each_way_or_of_both_is_a_link(tmp_path):
    def settings(name):
        link = str(tmp_path / name)
        return next(each.settings for each in conditions(link) if each.column == name)

    assert settings("mine.yaml") == [f"link.profile={tmp_path / 'mine.yaml'}"]
    (tmp_path / "both.csv").touch()
    for way in ("uplink", "downlink"):
        (tmp_path / f"mine-{way}.csv").touch()
    for name, trace in (("both.csv", "both.csv"), ("mine.csv", "mine-uplink.csv")):
        assert f"link.uplink.trace={tmp_path / trace}" in settings(name)
        assert "link.start_s=random" in settings(name)


@pytest.mark.full
def test_the_pages_have_the_numbers_of_this_version(tmp_path, call):
    call("reproduce", "--out", str(tmp_path / "paper"))
    made = (tmp_path / "paper" / "reproduce.md").read_text()
    assert made in PAGE.read_text()
    document = json.loads((tmp_path / "paper" / "reproduce.json").read_text())
    assert summary(document, range(2, 7)) in README.read_text()
