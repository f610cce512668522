# SPDX-License-Identifier: Apache-2.0

"""`cloudrc eval --codec`: images travel encoded, and the files say how."""

import json

import gymnasium
import pytest

from cloudrc.studies.eval.episode import play
from cloudrc.studies.eval.setup import BASELINE, Episode, EvalSetup
from tests.gym.test_codec import Eyes

gymnasium.register("Eyes-v0", Eyes)
LOOK = """
def infer(observation):
    return {"actions": [[float(observation["pixels"]["top"].mean()) / 255.0]]}
"""


@pytest.fixture
def setup(law):
    """The setup of an evaluation without a codec."""
    return EvalSetup("Eyes-v0", law(LOOK), link="ideal")


def test_the_policy_gets_the_images_that_are_left_but_not_without_a_network(setup):
    coded = EvalSetup(setup.env, setup.policy, codec="jpeg:10")
    alone, raw, left = (
        play(Episode(None, name, 1), each)
        for name, each in ((BASELINE, coded), ("newest", setup), ("newest", coded))
    )
    assert alone["records_sha256"] == raw["records_sha256"] != left["records_sha256"]
    assert left["numbers"]["frames_shown"] > 0.97
    assert 500 < left["numbers"]["observation_bytes"] < 4_000
    assert "frames_shown" not in raw["numbers"]


def test_without_a_codec_the_names_of_rows_are_as_before_it(setup):
    coded = EvalSetup(setup.env, setup.policy, codec="jpeg")
    assert "codec" not in setup.identity()
    for each, kept in ((Episode(None, BASELINE, 3), True), (Episode(None, "newest", 3), False)):
        assert (each.key(setup.identity()) == each.key(coded.identity())) is kept


def test_files_and_page_name_the_codec_and_its_library(setup, tmp_path, evaluate):
    words = "--env", "Eyes-v0", "--policy", setup.policy, "--seeds", 1, "--link", "lte", "--rtt", 40
    out = evaluate(*words, "--codec", "h264:300", "--out", tmp_path / "a").out
    assert "shown" in out
    document = json.loads((tmp_path / "a" / "eval.json").read_text())
    assert document["codec"] == document["identity"]["codec"] == "h264:300"
    assert document["versions"]["codec"].startswith("x264 of PyAV ")
    bare, over = document["outcomes"]
    assert "frames_shown" not in bare
    assert over["on_link_ms"] == pytest.approx(over["observation_bytes"] * 8 / 10_000, rel=0.1)
    assert "images as h264:300" in (tmp_path / "a" / "report.html").read_text()
    versus = [*words, "--versus", tmp_path / "a", "--out", tmp_path / "b"]
    assert "differs in --codec" in evaluate(*versus, code=2).err


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--codec", "png"], "--codec: no codec named 'png'"),
        (["--codec", "jpeg:99"], "--codec jpeg:99: "),
        (["--codec", "jpeg", "--observation-bytes", "9"], "leave --observation-bytes out"),
        (["--codec", "jpeg", "--env", "CartPole-v1"], "codec jpeg: there is no image"),
    ],
)
def test_a_codec_that_does_not_fit_is_refused_in_one_line(setup, evaluate, words, told):
    err = evaluate("--env", "Eyes-v0", "--policy", setup.policy, *words, code=2).err
    assert told in err
    assert err.count("\n") == 1
