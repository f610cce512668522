# SPDX-License-Identifier: Apache-2.0

"""The hash of the code depends on all sources that a flight can run, and on nothing else."""

import shutil
from pathlib import Path

import pytest

import cloudrc
from cloudrc.base import source
from tests.support.programs import loaded
from tools.wings import guests, layers

PACKAGE = Path(cloudrc.__file__).parent


@pytest.fixture
def hash_of(monkeypatch):
    """Return a function: path of a package (a folder, or inside a zip file) -> its hash."""

    def compute(package):
        monkeypatch.setattr(source, "files", lambda name: package)
        return source.code_hash.__wrapped__()

    return compute


@pytest.fixture
def copy(tmp_path):
    """Copy the package without what a build or an editor adds."""
    built = shutil.ignore_patterns("__pycache__", "*.so")
    return Path(shutil.copytree(PACKAGE, tmp_path / "cloudrc", ignore=built))


def test_built_files_and_those_of_an_editor_do_not_count(copy, hash_of):
    assert hash_of(copy) == source.code_hash()
    (copy / "__pycache__").mkdir()
    (copy / "__pycache__/source.cpython-313.pyc").write_bytes(b"built")
    (copy / "robots/native/step-1-cc.so").write_bytes(b"built")
    (copy / ".#assembly.py").symlink_to("somebody@host.1")
    (copy / "_chart").mkdir()
    (copy / "_chart/values.yaml").write_text("a: wheel has the chart\n")
    (copy / "doors/cli/run.py").write_text("# no flight imports the commands\n")
    assert hash_of(copy) == source.code_hash()


def test_each_kind_of_source_counts(copy, hash_of):
    seen = {source.code_hash()}
    names = "pelican/rotors.py", "native/step.c", "native/step.h", "x2/robot.xml", "x2/robot.yaml"
    for name in names:
        with (copy / "robots" / name).open("a") as file:
            file.write("\n")
        assert hash_of(copy) not in seen
        seen.add(hash_of(copy))


@pytest.mark.parametrize(
    ("path", "counts"),
    [
        ("base/rounding.py", True),
        ("wire/messages.py", True),
        ("link/model.py", True),
        ("physics/sim/plant.py", True),
        ("config/schema.py", True),
        ("results/metrics/flight.py", True),
        ("results/report/page.py", False),
        ("results/timeline/loops.py", False),
        ("world/robot.py", True),
        ("teleop/mission.py", True),
        ("cloud/loop.py", True),
        ("robots/check.py", True),
        ("flight/assembly/world.py", True),
        ("gym/networked.py", True),
        ("cluster/client.py", False),
        ("plugin.py", True),
        ("studies/eval/episode.py", True),
        ("studies/rank/environments.py", True),
        ("studies/rank/page.py", False),
        ("studies/sweep.py", False),
        ("doors/api.py", False),
    ],
)
def test_a_change_ends_a_sweep_or_an_eval_if_their_rows_may_depend_on_it(
    copy, hash_of, path, counts
):
    """Their rows have this hash, and their keys, too."""
    assert (copy / path).is_file()
    with (copy / path).open("a") as file:
        file.write("# changed\n")
    assert (hash_of(copy) != source.code_hash()) == counts


def test_each_wing_is_among_these():
    (mark,) = test_a_change_ends_a_sweep_or_an_eval_if_their_rows_may_depend_on_it.pytestmark
    seen = {path.partition("/")[0].removesuffix(".py") for path, _ in mark.args[1]}
    assert seen == {wing for line in layers() for wing in line}


def test_every_part_that_does_not_count_exists_and_no_wing_below_the_guests_is_one():
    parts = source.NOT_FLOWN - {"_chart"}
    there = {f"{path.relative_to(PACKAGE).with_suffix('')}" for path in PACKAGE.rglob("*")}
    assert parts <= there
    whole = {part for part in parts if "/" not in part}
    assert whole <= guests()


ROWS = {
    "sweep": (
        "from cloudrc.config.load import load_experiment\n"
        "from cloudrc.flight.in_memory import fly_point\n"
        "row = fly_point(load_experiment('steps', ['mission.steps.count=1']))\n"
        "assert row['verdict'] == 'success', row"
    ),
    "eval": (
        "from cloudrc.studies.eval.results import EpisodeTrial\n"
        "from cloudrc.studies.eval.setup import Episode, EvalSetup\n"
        "setup = EvalSetup('CartPole-v1', 'cloudrc/studies/rank/policies/pole.py', max_steps=3)\n"
        "row = EpisodeTrial('key', Episode(20.0, 'newest', 1), setup).play()\n"
        "assert row['numbers'], row"
    ),
    "rank": "import cloudrc.studies.rank.environments",
    "reproduce": "import cloudrc.studies.reproduce.flights",
}
"""Program -> what makes its rows."""


@pytest.mark.parametrize("rows", ROWS)
def test_what_makes_rows_runs_nothing_that_does_not_count(rows, monkeypatch):
    monkeypatch.chdir(PACKAGE.parent)
    run = {name for name in loaded(ROWS[rows]) if name.startswith("cloudrc.")}
    parts = {each.removeprefix("cloudrc.").replace(".", "/") for each in run}
    assert {"wire/messages", "results/metrics"} <= parts
    assert source.NOT_FLOWN.isdisjoint(parts)
