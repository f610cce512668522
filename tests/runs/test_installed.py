"""The key of a flight takes in the packages of installed plug-ins, of metrics, too."""

import sys

import pytest

from cloudrc import plugins
from cloudrc.errors import BadInputError
from cloudrc.runs import installed
from cloudrc.runs.grid import pack, read_grid, unpack

PLUG = """from cloudrc.cloud.predictors.last_sample import LastSample
from mypkg import consts
def build():
    return LastSample()
"""
METRIC = 'from mypkg import consts\nUNIT = "1"\ndef measure(flight):\n    return consts.GAIN\n'


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that installs a package with the given files and entry points."""
    site = tmp_path / "site"
    monkeypatch.syspath_prepend(str(site))

    def make(entry, files):
        about = site / "mypkg-1.0.dist-info"
        about.mkdir(parents=True, exist_ok=True)
        (about / "METADATA").write_text("Name: mypkg\nVersion: 1.0\n")
        kind, module = entry
        (about / "entry_points.txt").write_text(f"[cloudrc.{kind}]\nmine = {module}\n")
        for name, content in files.items():
            path = site / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        plugins._entries.cache_clear()  # as in the next command

    yield make
    for name in [each for each in sys.modules if each.partition(".")[0] in {"mypkg", "single"}]:
        del sys.modules[name]


def key(write_sweep, predictor="mine"):
    path = write_sweep({"cloud.predictor": [predictor]})
    (found,) = read_grid(path).flights
    return found


PACKAGE = {"mypkg/__init__.py": "", "mypkg/plug.py": PLUG}
PREDICTOR = ("predictors", "mypkg.plug")


@pytest.mark.parametrize(
    "name",
    [
        *("mypkg/consts.py", "mypkg/below/deep.py", "mypkg/gains.json"),
        "mypkg/__init__.py",
    ],
)
@pytest.mark.parametrize("entry", ["mypkg.plug", "mypkg.plug:build"])
def test_every_file_of_the_package_of_a_predictor_counts(install, write_sweep, name, entry):
    install(("predictors", entry), {**PACKAGE, "mypkg/consts.py": "GAIN = 1"})
    before, again = key(write_sweep), key(write_sweep)
    install(("predictors", entry), {name: "GAIN = 2"})
    assert before == again != key(write_sweep)


def test_what_python_and_an_editor_write_does_not_count(install, write_sweep):
    install(PREDICTOR, {**PACKAGE, "mypkg/consts.py": ""})
    before = key(write_sweep)
    install(PREDICTOR, {"mypkg/__pycache__/plug.pyc": "1", "mypkg/.plug.py": "1"})
    assert key(write_sweep) == before


def test_a_plugin_that_the_experiment_does_not_name_does_not_count(install, write_sweep):
    before = key(write_sweep, "last_sample")
    install(PREDICTOR, {**PACKAGE, "mypkg/consts.py": ""})
    assert key(write_sweep, "last_sample") == before


def test_every_installed_metric_counts(install, write_sweep):
    before = key(write_sweep, "last_sample")
    metric = ("metrics", "mypkg.metric")
    install(metric, {**PACKAGE, "mypkg/metric.py": METRIC, "mypkg/consts.py": "GAIN = 1"})
    with_metric = key(write_sweep, "last_sample")
    install(metric, {"mypkg/consts.py": "GAIN = 2"})
    assert len({before, with_metric, key(write_sweep, "last_sample")}) == 3


def test_modules_without_a_package_count_if_they_are_installed_together(install, write_sweep):
    single = PLUG.replace("from mypkg import consts", "import beside")
    listed = {"mypkg-1.0.dist-info/top_level.txt": "single\nbeside\n"}
    files = {"single.py": single, "beside.py": "GAIN = 1", **listed}
    install(("predictors", "single"), files)
    before = key(write_sweep)
    install(("predictors", "single"), {"beside.py": "GAIN = 2"})
    beside = key(write_sweep)
    install(("predictors", "single"), {"single.py": f"{single}# edited"})
    sys.modules.pop("beside", None)
    assert len({before, beside, key(write_sweep)}) == 3


def test_a_package_too_large_to_compare_is_refused(install, write_sweep, monkeypatch):
    install(PREDICTOR, {**PACKAGE, "mypkg/consts.py": ""})
    monkeypatch.setattr(installed, "FILES_MAX", 2)
    with pytest.raises(BadInputError, match="package mypkg has plug-ins and more than 2 files"):
        key(write_sweep)


def test_a_pod_with_another_version_of_a_plugin_refuses_the_flights(
    install, write_sweep, tmp_path, monkeypatch
):
    install(PREDICTOR, {**PACKAGE, "mypkg/consts.py": "GAIN = 1"})
    flights = read_grid(write_sweep({"cloud.predictor": ["mine"]})).flights
    packed = tmp_path / "flights"
    packed.write_bytes(pack(flights.values()))
    assert [each.key for each in unpack(packed)] == [*flights]
    install(PREDICTOR, {"mypkg/consts.py": "GAIN = 2"})
    with pytest.raises(BadInputError, match="another version of predictors mine"):
        unpack(packed)
