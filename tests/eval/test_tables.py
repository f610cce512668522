"""What `cloudrc eval` keeps and prints beside success and return."""

import json

import pytest

from cloudrc.eval.episode import play
from cloudrc.eval.setup import BASELINE, Episode, EvalSetup
from tests.eval.test_eval import bare, stand


def test_the_episodes_without_a_network_are_the_policys_own_whatever_link_and_time(law):
    setup = EvalSetup("CartPole-v1", law(), link="lossy", compute=0.3, observation_bytes=90)
    row = play(Episode(None, BASELINE, 3), setup)
    assert (row["numbers"]["return"], row["records_sha256"]) == bare("CartPole-v1", stand)
    assert row["point"] == {"rtt_ms": None, "executor": BASELINE}
    other = EvalSetup("CartPole-v1", setup.policy)
    for each, kept in ((Episode(None, BASELINE, 3), True), (Episode(None, "newest", 3), False)):
        assert (each.key(setup.identity()) == each.key(other.identity())) is kept


def test_the_table_is_also_one_of_csv_alone(law, tmp_path, evaluate):
    words = "--seeds 1 --rtt 0 -o csv --out".split()
    out = evaluate("--policy", law(), *words, tmp_path / "e").out
    assert out.startswith("rtt_ms,executor,episodes,return,steps,")
    assert "no network" in out


def test_two_policies_are_compared_in_pairs_and_other_conditions_are_refused(
    law, tmp_path, evaluate
):
    words = ["--seeds", 6, "--rtt", 0, "--success-at", 500, "--policy"]
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
    assert not (tmp_path / "c").exists()


def test_the_page_has_figure_tests_notes_and_how_it_was_made(law, tmp_path, monkeypatch, evaluate):
    monkeypatch.undo()
    words = "--seeds 2 --rtt 200,0 --deadline 0.1 --executor newest,time-indexed --policy".split()
    evaluate(*words, law(), "--out", out := tmp_path / "e")
    document = json.loads((out / "eval.json").read_text())
    page = (out / "report.html").read_text()
    made = document["cite"][:20], document["command"], "rate_kbit"
    for text in ("no network", "<svg", "P(age &gt;", "0/2/0", *made):
        assert text in page
    assert [each["rtt_ms"] for each in document["tests"]] == [0.0, 200.0]
    assert [each["rtt_ms"] for each in document["outcomes"]] == [None, *[0.0, 200.0] * 2]
