# SPDX-License-Identifier: Apache-2.0

"""Policies over networks: what is pinned, how it is scored, and which entries are refused."""

import json
from math import comb

import numpy as np
import pytest

from cloudrc.studies.eval.evidence import least_kept
from cloudrc.studies.rank import entry as entries
from cloudrc.studies.rank import play, tasks
from cloudrc.studies.rank.page import write_page
from cloudrc.studies.rank.score import in_order, score
from tests.conftest import nightly_rows
from tests.support import contrast

FULL = "1" * 50


def results(*grid, base=FULL):
    """Return results: digits without a network, then those at each round trip of the grid."""
    digits = [base, *grid, *["0" * 50] * (len(tasks.CONDITIONS) - 1 - len(grid))]
    pairs = zip(tasks.CONDITIONS, digits, strict=True)
    return [
        {"link": link, "rtt_ms": rtt, "success": each, "records_sha256": ""}
        for (link, rtt), each in pairs
    ]


def lost(count, of=50):
    return "0" * count + "1" * (of - count) + "0" * (50 - of)


def test_the_version_pins_its_tasks_and_links():
    found = {f"task {each}": tasks.hash_of_task(each) for each in tasks.TASKS}
    found |= {f"link {each}": tasks.hash_of_link(each) for each in tasks.LINKS}
    assert found == tasks.PINNED


@pytest.mark.parametrize(
    ("count", "least"), [(28, None), (29, 29), (45, 45), (46, 45), (50, 49), (100, 96)]
)
def test_more_than_90_percent_are_kept_if_the_losses_are_too_few_for_chance(count, least):
    """Exact: P(Binomial(n, .1) <= lost) < .05."""
    ways = [comb(count, k) * 0.1**k * 0.9 ** (count - k) for k in range(count + 1)]
    allowed = [k for k in range(count + 1) if sum(ways[: k + 1]) < 0.05]
    assert least_kept(count, 1, 0.9) == least == (count - max(allowed) if allowed else None)


@pytest.mark.parametrize(
    ("made", "words", "up_to"),
    [
        (results(FULL, lost(1), lost(2), FULL), "10 ms", 10.0),
        (results(lost(2), FULL), "none", None),
        (results(lost(0, 28), base=lost(0, 28)), "-, 28 of 50 without a network", None),
        (results(lost(0, 29), lost(1, 29), base=lost(0, 29)), "0 ms", 0.0),
        (results(*[FULL] * 10), "600 ms", 600.0),
        (results(base="0" * 50), "-, 0 of 50 without a network", None),
    ],
)
def test_the_first_round_trip_that_is_not_kept_ends_the_sequence(made, words, up_to):
    found = score(made)
    assert (found["score"], found["score_ms"]) == (words, up_to)


def test_a_later_recovery_counts_in_the_area_alone():
    once, again = score(results(FULL, "0" * 50)), score(results(FULL, "0" * 50, FULL, FULL))
    assert once["score"] == again["score"] == "0 ms"
    rtts = (0, 10, 20, 50, 100, 150, 200, 300, 450, 600)
    exact = np.trapezoid([1, 0, 1, 1, 0, 0, 0, 0, 0, 0], rtts) / 600
    assert again["area"] == pytest.approx(exact, abs=1e-6)
    assert once["area"] < exact


def test_entries_are_ordered_by_score_then_area_then_name_and_equal_scores_share_a_place():
    made = {
        "b": results(FULL, FULL),
        "a": results(FULL, FULL),
        "more area": results(FULL, FULL, lost(10)),
        "best": results(FULL, FULL, FULL),
        "none": results(lost(2), FULL, FULL),
        "few": results(FULL, FULL, FULL, base=lost(0, 20)),
    }
    given = [{"policy": name, "executor": "", **score(each)} for name, each in made.items()]
    given.append({"policy": "nan", "executor": "", **entries.FAILED})
    found = [(place, each["policy"]) for place, each in in_order(given)]
    scored = [(1, "best"), (2, "more area"), (2, "a"), (2, "b")]
    assert found == [*scored, (None, "none"), (None, "few"), (None, "nan")]


@pytest.fixture
def short(monkeypatch):
    """Return a function that shortens the ranking to some seeds and conditions."""

    def shorten(seeds, conditions):
        for module in (tasks, play, entries):
            monkeypatch.setattr(module, "SEEDS", range(1, seeds + 1))
            monkeypatch.setattr(module, "CONDITIONS", conditions)

    return shorten


GRID = tuple(each for each in tasks.CONDITIONS if each[0] in (tasks.NONE, tasks.CONSTANT))


def some(*rtts):
    """Return the conditions with these round trips [ms], and that without a network."""
    return tuple(each for each in GRID if each[1] in (None, *rtts))


FEW = ((tasks.NONE, None), (tasks.CONSTANT, 0.0), (tasks.CONSTANT, 50.0), ("wifi", None))


@pytest.mark.parametrize(
    ("policy", "words", "grid"),
    [
        ("linear", "100 ms", some(0.0, 100.0, 150.0)),
        ("smith", "600 ms", some(600.0)),
        *nightly_rows(("linear", "100 ms", GRID), ("smith", "600 ms", GRID)),
    ],
    ids=lambda each: each if isinstance(each, str) else len(each),
)
def test_the_margin_of_the_linear_plant_is_that_of_its_roots(policy, words, grid, short, tmp_path):
    """The plant has no noise, so that all seeds are one."""
    delays = {10: 0.9983, 11: 1.0053}  # steps -> largest root of z^(d+1) - 1.05 z^d + .12
    for steps, size in delays.items():
        roots = np.roots([1.0, -1.05, *[0.0] * (steps - 1), 0.12])
        assert abs(roots).max() == pytest.approx(size, abs=1e-4)
    short(1, grid)
    played = play.Played(tasks.Entrant("linear", policy, "newest"), tmp_path / "entry.json")
    assert played.play(1, None, lambda done: None) is None
    found = played.write()["results"]
    whole = [each | {"success": each["success"] * 50} for each in found]
    assert score(whole)["score"] == words


def test_the_predictor_of_the_linear_plant_answers_numbers_over_a_delay_that_varies(
    short, tmp_path
):
    short(27, (("5g-sa", None),))
    played = play.Played(tasks.Entrant("linear", "smith", "newest"), tmp_path / "entry.json")
    played.trials["5g-sa", None] = played.trials["5g-sa", None][-1:]
    assert played.play(1, None, lambda done: None) is None


def test_a_repetition_gives_the_same_file_and_shards_give_it_too(call, short, tmp_path):
    short(1, FEW)
    files = [tmp_path / name / "one.json" for name in ("a", "b")]
    for path, parts in zip(files, ([], ["--shard=1/2", "--shard=2/2", ""]), strict=True):
        for part in parts or [""]:
            call(f"rank --task pendulum --jobs 1 -o {path} {part}")
    had = files[0].read_bytes()
    assert had == files[1].read_bytes()
    (tmp_path / "a" / "one.rows" / "rows.jsonl").unlink()  # as if interrupted before all
    call(f"rank --task pendulum --jobs 1 -o {files[0]}")
    assert files[0].read_bytes() == had


def test_a_policy_that_answers_nan_is_a_row_and_not_dropped(call, short, tmp_path):
    short(2, FEW)
    (file := tmp_path / "nan.py").write_text(
        "def infer(observation):\n    return {'actions': [[float('nan')]]}\n"
    )
    call(f"rank --task pendulum --policy {file} --jobs 1 -o {tmp_path}/entry.json")
    made = entries.read_entry(tmp_path / "entry.json")
    assert (made["score"], made["results"]) == ("failed", [])
    write_page(tmp_path / "page.html", [tmp_path / "entry.json"])
    page = (tmp_path / "page.html").read_text()
    assert "<td>failed</td>" in page
    assert f"{file}, newest, failed: " not in page
    assert "nan.py, newest, failed: " in page


@pytest.fixture
def write(tmp_path):
    """Return a function that writes an entry with some results, and returns its path."""

    def write(policy, made, date="2026-11-30"):
        content = {
            **{"schemaVersion": 1, "rank": "1", "task": "linear", "policy": policy},
            **{"executor": "newest", **score(made), "failed": "", "answer": "below 1 ms"},
            **{"hashes": tasks.pinned("linear"), "results": made, "code": "0123"},
            **{"versions": {"cloudrc": "1"}, "command": "cloudrc rank", "date": date},
        }
        entries.write_entry(path := tmp_path / f"{policy}.json", content)
        return path

    return write


@pytest.fixture
def real(write):
    """Return the path of an entry with all seeds."""
    return write("entry", results(*[FULL] * 3))


def edit(content):
    content["results"][5]["success"] = FULL


def fewer(content):
    for each in content["results"]:
        each["success"] = each["success"][:20]


def reseal(content):
    content["sha256"] = entries._seal(content)


def both(content):
    content["failed"] = "it answered NaN"
    reseal(content)


def without_versions(content):
    content["versions"] = {}
    reseal(content)


FALSE = {
    "was edited: it has results, and says": both,
    "it has no text command": lambda content: content.update(command=3),
    "it has no text policy": lambda content: content.pop("policy"),
    "is no entry of 'cloudrc rank' ('cloudrc')": without_versions,
    "is of version 2; this cloudrc ranks version 1": lambda content: content.update(rank="2"),
    "has another link wifi than version 1": lambda content: content["hashes"].update(
        {"link wifi": "0"}
    ),
    "has 20 seeds in place of 50": fewer,
    "was edited": edit,
    "is no entry": lambda content: content.pop("rank"),
}


@pytest.mark.parametrize("why", FALSE)
def test_a_false_entry_is_refused_by_name(why, real, call):
    call(f"rank page {real}")
    content = json.loads(real.read_text())
    FALSE[why](content)
    real.write_text(json.dumps(content))
    said = call(f"rank page {real}", code=2).err
    assert f"{real}: " in said
    assert why in said


def test_a_file_that_is_not_there_is_named(call, tmp_path):
    said = call(f"rank page {tmp_path}/nosuch.json", code=2).err
    assert f"{tmp_path}/nosuch.json: is no entry of 'cloudrc rank' (there is no such file)" in said


def test_no_text_of_an_entry_is_a_part_of_the_page(real, tmp_path):
    content = json.loads(real.read_text())
    for key in ("date", "answer", "code", "command", "policy"):
        content[key] = f"<script>{key}</script>"
    reseal(content)
    real.write_text(json.dumps(content))
    write_page(tmp_path / "page.html", [real])
    found = (tmp_path / "page.html").read_text()
    assert found.count("<script>") == 1, "that of the page"


def test_a_copy_of_an_entry_is_no_second_one(real, tmp_path):
    (copy := tmp_path / "copy.json").write_bytes(real.read_bytes())
    write_page(tmp_path / "page.html", [real, copy])
    assert (tmp_path / "page.html").read_text().count("entry.json") == 1


def test_what_is_not_installed_is_named_with_its_extra(call, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if "world" in name else 1)
    said = call("rank --task reach-v3", code=3).err
    assert "metaworld (not installed)" in said
    assert "cloudrc[arms]" in said


def test_a_policy_may_need_an_extra_that_its_task_does_not_need(monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if "policy" in name else 1)
    found = tasks.shipped(["hover-motors", "hover-velocity"])  # the same drone
    assert {each.policy: each.lacking for each in found} == {"raptor": ["rank"], "velocity": []}


@pytest.mark.process
def test_the_page_sorts_by_every_column_and_can_be_read(write, browse, tmp_path):
    made = {
        "far": results(*[FULL] * 5),
        "near": results(*[FULL] * 3),
        "none": results(lost(9), *[lost(1)] * 9),
        **{f"other {n}": results(lost(n)) for n in range(2, 6)},  # more than there are colours
    }
    dates = [f"2026-11-{day:02}" for day in range(30, 0, -3)]
    files = [write(*each, date) for each, date in zip(made.items(), dates, strict=False)]
    write_page(tmp_path / "page.html", files)
    page = browse((tmp_path / "page.html").as_uri())

    def order(head, clicks):
        for _ in range(clicks):
            page.locator("th button", has_text=head).click()
        cells = page.locator("tbody tr td:nth-child(2)").all_inner_texts()
        return [each.strip().removesuffix(", newest") for each in cells]

    by_place = order("place", 0)
    assert by_place[:2] == ["far", "near"]
    assert order("policy", 1) == sorted(made)
    assert order("policy", 1) == sorted(made, reverse=True)
    assert order("score", 2)[:2] == ["far", "near"], "none and - come last"
    assert order("area", 2)[0] == "none", "it wins the most"
    assert order("played", 1) == [*made][::-1]
    page.locator("tbody a", has_text="near").click()
    assert page.url.endswith("near.json")
    page.go_back()
    assert page.evaluate(contrast.TEXTS) == []
    assert page.evaluate(contrast.LINES, "polyline, td path") == []
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
