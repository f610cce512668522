# SPDX-License-Identifier: Apache-2.0

"""The package: dependencies, version, licence and the files of the wheel."""

import os
import re
import shutil
import subprocess
import sys
import tomllib
import venv
import zipfile
from hashlib import sha256
from importlib.metadata import distribution
from pathlib import Path

import pytest

import cloudrc
from cloudrc.robots.native.library import built_file, compilers
from tests.support.commands import python
from tools.pack_chart import pack
from tools.set_registry import set_registry

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SHIPPED = {".py", ".c", ".yaml", ".xml", ".typed", ".csv", ".html", ".css", ".js", ".mplstyle"}


def test_cloudrc_is_a_plugin_of_kubectl_and_names_one_version():
    assert PROJECT["scripts"]["kubectl-cloudrc"] == PROJECT["scripts"]["cloudrc"]
    assert f"\nversion: {cloudrc.__version__}\n" in (ROOT / "CITATION.cff").read_text()


@pytest.mark.parametrize("group", PROJECT["entry-points"])
def test_the_entry_points_of_guests_name_what_there_is(group):
    ours = {entry.name: entry for entry in distribution("cloudrc").entry_points.select(group=group)}
    assert {name: entry.value for name, entry in ours.items()} == PROJECT["entry-points"][group]
    assert all(entry.load() for entry in ours.values())


def build(root, folder, *targets):
    """Build `targets` ("wheel", "sdist") of the tree `root` in `folder`."""
    pytest.importorskip("hatchling", reason="the build backend comes with the extra dev")
    command = [sys.executable, "-m", "hatchling", "build", "-d", str(folder)]
    for target in targets:
        command += ["-t", target]
    subprocess.run(command, cwd=root, check=True, capture_output=True)


def wheel_in(folder):
    """Return the name of the wheel in `folder`, and the names of the package's files in it."""
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    about = f"{'-'.join(wheel.name.split('-')[:2])}.dist-info/"
    assert all(name.startswith(("cloudrc/", about)) for name in names), "nothing but the package"
    return wheel.name, {name for name in names if name.startswith("cloudrc/")}


@pytest.fixture(scope="module", autouse=True)
def stamp():
    """Build as a release does."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", "1700000000")
        patch.delenv("CLOUDRC_NATIVE", raising=False)
        yield


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """Build wheel and source distribution of this tree."""
    folder = tmp_path_factory.mktemp("built")
    build(ROOT, folder, "wheel", "sdist")
    return folder


def test_the_wheel_holds_every_file_of_the_package(built):
    name, packed = wheel_in(built)
    assert name.endswith("-py3-none-any.whl")
    source = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "cloudrc").rglob("*")
        if path.suffix in SHIPPED and "__pycache__" not in path.parts
    }
    assert source <= packed
    assert {"cloudrc/_chart/Chart.yaml", "cloudrc/_chart/templates/NOTES.txt"} <= packed


@pytest.mark.skipif(not list(compilers()), reason="no compiler here")
def test_a_platform_wheel_holds_the_machine_code(tmp_path, monkeypatch):
    monkeypatch.setenv("CLOUDRC_NATIVE", "1")
    build(ROOT, tmp_path, "wheel")
    name, packed = wheel_in(tmp_path)
    assert "-py3-none-any" not in name
    assert f"cloudrc/robots/native/{built_file().name}" in packed
    assert not built_file().exists()


@pytest.fixture
def copied(tmp_path):
    """Copy what a package is made of, with new times and other rights."""
    tree = tmp_path / "tree"
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        check=True,
        capture_output=True,
        text=True,
    )
    for name in filter(None, listed.stdout.split("\0")):
        if (ROOT / name).exists():
            (tree / name).parent.mkdir(parents=True, exist_ok=True)
            (tree / name).write_bytes((ROOT / name).read_bytes())
            (tree / name).chmod(0o600)
            os.utime(tree / name, (1e9, 1e9))
    return tree


def contents(folder):
    """Return file name -> hash of its bytes: of bytes, a failure would be described for minutes."""
    return {path.name: sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def test_two_builds_of_one_tree_are_byte_equal(copied, built, tmp_path):
    build(copied, tmp_path / "again", "wheel", "sdist")
    assert len(contents(built)) == 2
    assert contents(tmp_path / "again") == contents(built)


@pytest.mark.skipif(not shutil.which("helm"), reason="no helm here")
@pytest.mark.parametrize("is_published", [False, True])
def test_every_image_of_a_releases_chart_is_the_one_that_it_publishes(tmp_path, is_published):
    """The chart names digests; the wheel, which is built before them, the version."""
    chart = shutil.copytree(ROOT / "charts" / "cloudrc", tmp_path / "cloudrc")
    names = ("world", "cloud", "cloud-ros")
    ends = {name: f"@sha256:{n:064}" for n, name in enumerate(names)}
    set_registry(chart, "ghcr.io/me", {k: end[1:] for k, end in ends.items() if is_published})
    packed = pack(chart, tmp_path / "packed", 0)
    parts = ["mission.enabled=true", "console.enabled=true", "cloud.backgroundLoad.enabled=true"]

    def rendered(*parts):
        command = [
            "helm",
            "template",
            "x",
            packed,
            "--kube-version=1.29.0",
            *(f"--set={part}" for part in parts),
        ]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    texts = rendered(*parts), rendered(*parts, "cloud.ros.enabled=true")
    for text in (*texts, *(path.read_text() for path in (chart / "examples").glob("*-job.yaml"))):
        images = set(re.findall(r"\bimage: (\S+)", text))
        ends = ends if is_published else dict.fromkeys(names, f":{cloudrc.__version__}")
        roles = {f"ghcr.io/me/cloudrc/{name}{ends[name]}" for name in names}
        assert images
        assert images <= roles


@pytest.mark.full
def test_the_wheel_alone_lists_then_flies_and_hands_out_the_exercise(built, tmp_path):
    """It is installed in a new environment, far from the clone."""
    programs, (wheel,) = tmp_path / "venv" / "bin", built.glob("*.whl")
    venv.create(tmp_path / "venv", with_pip=True)
    clean = {key: text for key, text in os.environ.items() if key != "PYTHONPATH"}

    def install(extras):
        words = ["-m", "pip", "install", "--quiet", f"{wheel}{extras}"]
        subprocess.run([programs / "python", *words], check=True, cwd=tmp_path)

    def cloudrc(*words):
        how = {"cwd": tmp_path, "env": clean, "capture_output": True, "text": True}
        return subprocess.run([programs / "cloudrc", *words], **how)

    install("")
    assert cloudrc("list").returncode == 0
    for words, extra in (
        (["run", "--mode", "virtual"], "cloudrc[sim]"),
        (["up", "--console"], "cloudrc[sim,api,console]"),
        (["console", "--cluster"], "cloudrc[kube]"),
    ):
        refused = cloudrc(*words)
        assert (refused.returncode, extra in refused.stderr) == (3, True), refused.stderr
    install("[sim]")
    flown = cloudrc("run", "--mode", "virtual", "--out", "run")
    assert flown.returncode == 0, flown.stderr
    assert (tmp_path / "run" / "report.html").exists()
    assert cloudrc("class", "new", "exercise").returncode == 0
    assert "score 0 of 100" in cloudrc("class", "check", "exercise").stdout


BASE = """
import importlib.util, sys
from cloudrc.base.requirements import EXTRAS

gone = {module for modules in EXTRAS.values() for module in modules}
found = importlib.util.find_spec

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in gone:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
importlib.util.find_spec = lambda name: None if name in gone else found(name)

import cloudrc
from cloudrc.doors.cli.main import main
from cloudrc.base.errors import MissingPrerequisiteError

assert main(["list", "metrics"]) == 0
for words in (["sweep", "status", "runs"], ["sweep", "run", "s.yaml"], ["down"]):
    assert main(words) == 3, words
for call in (cloudrc.fly, lambda: cloudrc.sweep({}), lambda: cloudrc.identify("run")):
    try:
        call()
    except MissingPrerequisiteError as error:
        print(error, file=sys.stderr)
"""


def test_without_extras_numbers_are_listed_and_what_lacks_an_extra_names_it(tmp_path):
    done = python("-c", BASE, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "duration" in done.stdout
    lines = done.stderr.splitlines()
    assert len(lines) == 6
    assert all("run: pip install 'cloudrc[" in line for line in lines), lines
