# SPDX-License-Identifier: Apache-2.0

"""The key of a flight takes in the versions of installed plug-ins, of metrics, too."""

import sys

import pytest

from cloudrc.base import plugins
from cloudrc.base.errors import BadInputError
from cloudrc.flight.trials.fingerprint import installed_plugins
from cloudrc.flight.trials.plan import pack, read_plan, unpack

PLUG = """from cloudrc.cloud.predictors.last_sample import LastSample
from mypkg import consts
def build():
    return LastSample()
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that installs a package with the given files and entry points."""
    site = tmp_path / "site"
    monkeypatch.syspath_prepend(str(site))

    def make(entry, files):
        about = site / "mypkg-1.0.dist-info"
        about.mkdir(parents=True, exist_ok=True)
        (about / "METADATA").write_text("Name: mypkg\nVersion: 1.0\n")
        (about / "top_level.txt").write_text("mypkg")
        kind, module = entry
        (about / "entry_points.txt").write_text(f"[cloudrc.{kind}]\nmine = {module}\n")
        for name, content in files.items():
            path = site / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(content)
        for cached in (plugins._entries, plugins._distributions):
            cached.cache_clear()  # as in the next command

    yield make
    for name in [each for each in sys.modules if each.partition(".")[0] == "mypkg"]:
        del sys.modules[name]


def key(write_sweep):
    path = write_sweep({"cloud.predictor": ["mine"]})
    (found,) = read_plan(path).flights
    return found


def test_what_cloudrc_brings_itself_is_no_plug_in_of_another_package():
    assert "ros2" in plugins.names("transports")
    assert installed_plugins() == {}


PACKAGE = {"mypkg/__init__.py": "", "mypkg/plug.py": PLUG}
PREDICTOR = ("predictors", "mypkg.plug")


def test_the_version_of_a_plug_in_counts(install, write_sweep):
    install(PREDICTOR, {**PACKAGE, "mypkg/consts.py": ""})
    before, again = key(write_sweep), key(write_sweep)
    install(PREDICTOR, {"mypkg-1.0.dist-info/METADATA": "Name: mypkg\nVersion: 1.1\n"})
    assert before == again != key(write_sweep)


@pytest.mark.parametrize("entry", ["mypkg.plug", "mypkg.plug:build"])
def test_what_a_plug_in_of_an_editable_package_imports_counts(install, write_sweep, entry):
    """Its version stays while its code changes."""
    install(("predictors", entry), {**PACKAGE, "mypkg/consts.py": "GAIN = 1"})
    before = key(write_sweep)
    install(("predictors", entry), {"mypkg/consts.py": "GAIN = 2"})
    assert key(write_sweep) != before


def test_a_pod_with_another_version_of_a_plugin_refuses_the_flights(
    install, write_sweep, tmp_path, monkeypatch
):
    install(PREDICTOR, {**PACKAGE, "mypkg/consts.py": "GAIN = 1"})
    flights = read_plan(write_sweep({"cloud.predictor": ["mine"]})).flights
    packed = tmp_path / "flights"
    packed.write_bytes(pack(flights.values()))
    assert [each.key for each in unpack(packed)] == [*flights]
    install(PREDICTOR, {"mypkg/consts.py": "GAIN = 2"})
    with pytest.raises(BadInputError, match="other code or plug-ins"):
        unpack(packed)
