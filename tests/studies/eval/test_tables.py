# SPDX-License-Identifier: Apache-2.0

"""What `cloudrc eval` keeps and prints beside success and return."""

import csv
import json
import shutil
import sys
from pathlib import Path

import pytest

from cloudrc.base.errors import InterruptedRunError
from cloudrc.flight.trials.rows import read_rows
from cloudrc.studies.eval.episode import play
from cloudrc.studies.eval.page import PANELS, panel_of
from cloudrc.studies.eval.setup import BASELINE, Episode, EvalSetup
from tests.studies.eval.test_eval import bare, stand
from tests.studies.policy.conftest import serving


def test_the_episodes_without_a_network_are_the_policys_own_whatever_link_and_time(law):
    setup = EvalSetup("CartPole-v1", law(), link="lossy", compute=0.3, observation_bytes=90)
    row = play(Episode(None, BASELINE, 3), setup)
    assert (row["numbers"]["return"], row["records_sha256"]) == bare("CartPole-v1", stand)
    assert row["point"] == {"rtt_ms": None, "executor": BASELINE}
    other = EvalSetup("CartPole-v1", setup.policy)
    for each, kept in ((Episode(None, BASELINE, 3), True), (Episode(None, "newest", 3), False)):
        assert (each.key(setup.identity()) == each.key(other.identity())) is kept


def test_the_table_is_also_one_of_csv_alone(law, tmp_path, evaluate):
    words = "--seeds 1 --rtt 0 --max-steps 9 -o csv --out".split()
    out = evaluate("--policy", law(), *words, tmp_path / "e").out
    assert out.startswith("rtt_ms,executor,episodes,return,steps,")
    assert "no network" in out


def test_two_policies_are_compared_in_pairs_and_other_conditions_are_refused(
    law, tmp_path, evaluate
):
    words = ["--seeds", 6, "--rtt", 0, "--max-steps", 60, "--success-at", 60, "--policy"]
    (tmp_path / "left.py").write_text("def infer(o):\n    return {'actions': [[0]]}\n")
    evaluate(*words, tmp_path / "left.py", "--out", tmp_path / "a")
    versus = [*words, law(), "--versus", tmp_path / "a", "--out"]
    assert str(tmp_path / "a") in evaluate(*versus, tmp_path / "b").out
    document = json.loads((tmp_path / "b" / "eval.json").read_text())
    _, test = document["tests"]
    assert (test["b"], test["success"]["only_b"]) == ("newest", 6)
    assert test["a"] == f"newest of {tmp_path}/a"
    assert test["success"]["p_holm"] == pytest.approx(4 * 2 / 2**6)
    for name, value in (("link", "lte"), ("answer-within", 0.02)):
        refused = evaluate(*versus, tmp_path / "c", f"--{name}", value, code=2).err
        assert f"a: differs in {name.replace('-', '_')}; " in refused
    refused = evaluate(*versus, tmp_path / "c", "--delivery", "stream", code=2).err
    assert "--delivery datagrams" in refused
    assert not (tmp_path / "c").exists()


def test_a_later_call_keeps_the_comparison_and_adds_no_seeds_unmarked(law, tmp_path, evaluate):
    for name in ("left", "right"):
        path, action = tmp_path / f"{name}.py", int(name == "right")
        path.write_text(f"def infer(o):\n    return {{'actions': [[{action}]]}}\n")
        words = ["--success-at", 5, "--policy", path, "--out", tmp_path / name, "--seeds"]
        more = ["--versus", tmp_path / "left"] if action else []
        evaluate(*words, 2, *more)
    said = evaluate(*words, 2)
    document = json.loads((tmp_path / "right" / "eval.json").read_text())
    assert (document["versus"], document["seeds"]) == (str(tmp_path / "left"), [2])
    assert len(document["tests"]) == 2
    assert "number of seeds has changed" not in said.out
    assert "changed in this folder: 2, then 3" in evaluate(*words, 3).out
    shutil.rmtree(tmp_path / "left")
    said = evaluate(*words, 3)
    assert f"comparison of an earlier call is left out: --versus {tmp_path}/left" in said.err
    assert json.loads((tmp_path / "right" / "eval.json").read_text())["tests"] == []


COUNTING = """
def infer(observation):
    with open(__file__ + ".asked", "a") as file:
        file.write(".")
    return {"actions": [[0]]}
"""


def test_rows_are_also_written_flat_and_then_nothing_is_played(law, tmp_path, evaluate):
    path, file = law(COUNTING), tmp_path / "flat.csv"
    words = ["--policy", path, "--rtt", 40, "--seeds", 2, "--out", tmp_path / "e"]
    evaluate(*words)
    asked = Path(path + ".asked").read_text()
    for _ in range(2):
        evaluate(*words, "--rows", file)
    assert Path(path + ".asked").read_text() == asked
    lines = list(csv.DictReader(file.read_text().splitlines()))
    rows = [json.loads(line) for line in (tmp_path / "e" / "rows.jsonl").read_text().splitlines()]
    assert [each["key"] for each in lines] == [each["key"] for each in rows]
    assert [(each["executor"], each["rtt_ms"], each["seed"]) for each in lines] == [
        ("no network", "", "1"),
        ("no network", "", "2"),
        ("newest", "40.0", "1"),
        ("newest", "40.0", "2"),
    ]
    last, numbers = lines[-1], rows[-1]["numbers"]
    assert float(last["delay_measured_uplink [s]"]) == numbers["delay_measured_uplink"]
    assert (float(last["return"]), last["ended"]) == (numbers["return"], rows[-1]["ended"])


@pytest.mark.parametrize(
    ("name", "code", "text"),
    [
        ("flat.txt", 2, "name a file that ends in .csv or .parquet"),
        ("none/flat.csv", 2, "there is no folder"),
        ("times.csv", 2, "already there; name another file with --rows"),
        ("flat.parquet", 3, "needs pyarrow; run: pip install pyarrow"),
    ],
)
def test_a_file_for_rows_that_cannot_be_written_is_refused_before(
    law, tmp_path, evaluate, monkeypatch, name, code, text
):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    (tmp_path / "times.csv").write_text("0.1\n")
    words = ["--policy", law(), "--out", tmp_path / "e", "--rows", tmp_path / name]
    assert text in evaluate(*words, code=code).err
    assert not (tmp_path / "e").exists()


def test_the_line_to_continue_fits_the_call(law, tmp_path, evaluate, monkeypatch):
    def interrupted(folder, *_, keep):
        return [], InterruptedRunError("interrupted")

    monkeypatch.setattr("cloudrc.studies.eval.results.play_missing", interrupted)
    monkeypatch.chdir(tmp_path)
    words, code = ["--policy", law(), "--seeds", 1], InterruptedRunError.exit_code
    said = evaluate(*words, code=code).err
    assert "interrupted; to continue, add --out runs/eval-CartPole-v1-1\n" in said
    said = evaluate(*words, "--out", "e", code=code).err
    assert "interrupted; to continue, give the same command again\n" in said


def test_a_condition_without_any_answer_stands_at_the_asked_time():
    bare = {"executor": BASELINE, "success": 1.0, "loop_age_ms": 0.0}
    asked = {"delay_asked_uplink_ms": 180.0, "delay_asked_downlink_ms": 120.0}
    known = {"executor": "broker", "success": 0.5, "loop_age_ms": 65.0}
    unknown = {"executor": "broker", "success": 0.0, **asked}
    points = panel_of([bare, {**known, **asked}, unknown], 0.05, *PANELS[0]).lines["broker"]
    assert [(each.x, each.failed) for each in points] == [(65, False), (350, True)]


def test_the_bytes_of_an_observation_and_their_time_on_the_link_are_told(law, tmp_path, evaluate):
    words = "--link lte --rtt 0 --seeds 1 --max-steps 60 --observation-bytes 27600 --policy".split()
    run = evaluate(*words, law(), "--out", tmp_path / "a")
    assert (
        "27,600 bytes in 23 packets (datagrams), 22.595 ms" in run.err
    )  # at 10 Mbit/s, with headers
    assert "27,600 B, 22.595 ms" in run.out
    document = json.loads((tmp_path / "a" / "eval.json").read_text())
    found = document["outcomes"][1], document
    for each in found:
        assert (each["observation_bytes"], each["observation_packets"]) == (27_600, 23)
        assert each["on_link_ms"] == pytest.approx((27_600 + 23 * 28) * 8 / 10_000, abs=5e-4)
    (row,) = (each for each in read_rows(tmp_path / "a").values() if each["point"]["rtt_ms"] == 0)
    assert row["numbers"]["packets_sent_uplink"] % 23 == 0


def test_a_server_is_asked_over_a_stream_unless_another_delivery_is_given(law, tmp_path, evaluate):
    words = "--link lossy --rtt 0 --seeds 1 --max-steps 60 --observation-bytes 27600 --out".split()
    with serving(law()) as url:
        evaluate(*words, tmp_path / "a", "--policy", url)
        evaluate(*words, tmp_path / "b", "--policy", url, "--delivery", "datagrams")
    read = [json.loads((tmp_path / name / "eval.json").read_text()) for name in "ab"]
    assert [each["delivery"] for each in read] == ["stream", "datagrams"]
    assert [each["outcomes"][1]["loss_uplink"] > 0 for each in read] == [False, True]


def test_the_page_has_figure_tests_notes_and_how_it_was_made(law, tmp_path, monkeypatch, evaluate):
    monkeypatch.undo()
    monkeypatch.setattr("cloudrc.studies.eval.page.PRINT_KINDS", ("svg",))
    words = "--seeds 2 --rtt 200,0 --deadline 0.1 --executor newest,time-indexed --policy".split()
    limit = "--env-arg", "max_episode_steps=60"
    evaluate(*words, law(), *limit, "--out", out := tmp_path / "e")
    document = json.loads((out / "eval.json").read_text())
    page = (out / "report.html").read_text()
    made = document["cite"][:20], document["command"], "rate_kbit"
    for text in ("no network", "P(age &gt;", "0/2/0", *made):
        assert text in page
    assert page.count("<svg") == 2
    assert [each["rtt_ms"] for each in document["tests"]] == [0.0, 200.0]
    assert [each["rtt_ms"] for each in document["outcomes"]] == [None, *[0.0, 200.0] * 2]
