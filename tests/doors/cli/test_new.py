# SPDX-License-Identifier: Apache-2.0

"""`cloudrc new` writes what flies, and a test of it."""

import pytest

from cloudrc.doors.new import NEW
from tests.support.camera import needs_renderer

PLUGINS = [kind for kind in NEW if kind != "robot"]
CAMERA = pytest.param("perception --camera", marks=needs_renderer)


@pytest.mark.parametrize("kind", [*PLUGINS, CAMERA])
def test_a_new_plugin_passes_its_own_test_and_the_check(tmp_path, call, as_json, kind):
    name = f"my_{'_'.join(kind.split(' --'))}"
    said = call(f"new {kind} {name}.py").out
    assert f"cloudrc check ./{name}.py" in said
    assert f"pytest ./test_{name}.py" in said
    assert {file.name for file in tmp_path.iterdir()} == {f"{name}.py", f"test_{name}.py"}
    test = tmp_path / f"test_{name}.py"
    assert pytest.main(["-q", "-p", "no:cacheprovider", "-p", "no:xdist", str(test)]) == 0
    found = as_json(f"check {name}.py")
    assert (found["kind"], found["ok"]) == (kind.split()[0], True)


def test_a_file_imports_all_from_one_module(tmp_path, call):
    for kind in PLUGINS:
        call(f"new {kind} {kind}.py")
        text = (tmp_path / f"{kind}.py").read_text()
        assert text.startswith('"""'), "the licence is the user's"
        assert text.count("cloudrc") == text.count("from cloudrc.plugin import ") + (
            kind == "executor"  # which names the flag of `cloudrc eval`
        )


@pytest.mark.parametrize(
    ("experiment", "option", "short"),
    [
        ("gap", "", ""),
        pytest.param(
            "follow", "--camera", "--set mission.follow.duration_s=6", marks=needs_renderer
        ),
    ],
)
def test_a_new_perception_moves_the_robot(call, experiment, option, short):
    said = call(f"new perception mine.py {option}").out
    mine = f"run {experiment} --mode virtual --set cloud.perception=./mine.py"
    assert mine in said
    flown = call(f"{mine} --report none --out run {short}")
    assert "SUCCESS" in flown.out
    assert "perception_failed" not in flown.out


POLICY = """
def infer(observation):
    (x,) = map(float, observation["observation/state"])
    return {"actions": [[-0.1 * x * 0.9**k] for k in range(16)]}
"""


def test_a_new_executor_plays_in_eval(tmp_path, as_json, call, monkeypatch):
    for name in ("draw_outcomes", "draw_ages"):  # which takes seconds
        monkeypatch.setattr(f"cloudrc.studies.eval.page.{name}", lambda *_: {"svg": b"<svg/>"})
    call("new executor mine.py")
    (tmp_path / "policy.py").write_text(POLICY)
    plant = "--env cloudrc/Linear-v0 --env-arg A=1.0 --env-arg W=0.0 --env-arg x0=1.0"
    how = "--policy ./policy.py --link lte --executor ./mine.py --set period=3"
    found = as_json(f"eval {plant} {how} --seeds 1 --jobs 1 --max-steps 60 --dt 0.02")
    assert found["outcomes"][1]["executor"] == "./mine.py period=3"


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("perception mine", "mine: name a Python file, such as mine.py"),
        ("predictor mine.py", "mine.py: exists already"),
        ("metric yours.py", "test_yours.py: exists already"),
        ("controller my-own.py", "my-own.py: its name is no identifier of Python"),
        ("predicter a.py", "no choice named 'predicter'"),
        ("executor no/folder.py", "no"),
    ],
)
def test_what_is_there_stays(tmp_path, refused, words, why):
    files = {tmp_path / "mine.py", tmp_path / "test_yours.py"}
    for file in files:
        file.write_text("mine")
    assert why in refused(f"new {words}")
    assert {*tmp_path.iterdir()} == files
    assert {file.read_text() for file in files} == {"mine"}
