"""What `cloudrc eval` keeps and prints beside success and return."""

import json

import pytest

from cloudrc.eval.episode import play
from cloudrc.eval.setup import BASELINE, Episode, EvalSetup
from tests.eval.test_eval import bare, run, stand


def test_the_episodes_without_a_network_are_the_policys_own_whatever_link_and_time(law):
    setup = EvalSetup("CartPole-v1", law(), link="lossy", compute=0.3, observation_bytes=90)
    row = play(Episode(None, BASELINE, 3), setup)
    assert (row["numbers"]["return"], row["records_sha256"]) == bare("CartPole-v1", stand, 3)
    assert row["point"] == {"rtt_ms": None, "executor": BASELINE}
    other = EvalSetup("CartPole-v1", setup.policy)
    for each, kept in ((Episode(None, BASELINE, 3), True), (Episode(None, "newest", 3), False)):
        assert (each.key(setup.identity()) == each.key(other.identity())) is kept


def test_the_table_is_also_one_of_csv_alone(law, tmp_path, capsys):
    words = "--seeds 1 --rtt 0 -o csv --out".split()
    assert run("--policy", law(), *words, tmp_path / "e") == 0
    out = capsys.readouterr().out
    assert out.startswith("rtt_ms,executor,episodes,return,steps,")
    assert "no network" in out


def test_two_policies_are_compared_in_pairs_and_other_conditions_are_refused(law, tmp_path, capsys):
    words = ["--seeds", 6, "--rtt", 0, "--success-at", 500]
    (tmp_path / "left.py").write_text("def infer(o):\n    return {'actions': [[0]]}\n")
    assert run("--policy", tmp_path / "left.py", "--out", tmp_path / "a", *words) == 0
    versus = ["--policy", law(), "--versus", tmp_path / "a"]
    assert run(*versus, "--out", tmp_path / "b", *words) == 0
    document = json.loads((tmp_path / "b" / "eval.json").read_text())
    _, test = document["tests"]
    assert (test["b"], test["success"]["only_b"]) == ("newest", 6)
    assert test["a"] == f"newest of {tmp_path}/a"
    assert test["success"]["p_holm"] == pytest.approx(4 * 2 / 2**6)
    assert str(tmp_path / "a") in capsys.readouterr().out
    assert run(*versus, "--out", tmp_path / "c", *words, "--link", "lte") == 2
    assert "a: differs in link; " in capsys.readouterr().err
    assert run(*versus, "--out", tmp_path / "c", *words, "--answer-within", 0.02) == 2
    assert "a: differs in answer_within; " in capsys.readouterr().err
    assert not (tmp_path / "c").exists()


def test_the_page_has_figure_tests_notes_and_how_it_was_made(law, tmp_path, monkeypatch):
    monkeypatch.undo()
    out, words = (
        tmp_path / "e",
        ["--policy", law(), "--seeds", 2, "--rtt", "200,0", "--deadline", 0.1],
    )
    assert run(*words, "--out", out, "--executor", "newest,time-indexed") == 0
    document, page = (
        json.loads((out / "eval.json").read_text()),
        (out / "report.html").read_text(),
    )
    for text in (
        "no network",
        "<svg",
        "P(age &gt;",
        "0/2/0",
        document["cite"][:20],
        document["command"],
        "rate_kbit",
    ):
        assert text in page
    assert [each["rtt_ms"] for each in document["tests"]] == [0.0, 200.0]
    assert [each["rtt_ms"] for each in document["outcomes"]] == [None, *[0.0, 200.0] * 2]
