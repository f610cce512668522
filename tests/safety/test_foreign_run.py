# SPDX-License-Identifier: Apache-2.0

"""A run's folder from somebody else: reading it executes none of its code."""

import json
import os
import subprocess
from pathlib import Path

import pytest

from cloudrc.config.choice import PlugIn
from cloudrc.config.load import read_experiment
from cloudrc.config.resolved import dump
from cloudrc.doors.cli.main import main
from cloudrc.flight.links.verify import find_experiment
from cloudrc.flight.machine import interpreter
from cloudrc.flight.pod import ends
from cloudrc.flight.trials.workers import map_in_order
from cloudrc.results.report.figures import FIGURES
from tests.results.metrics.conftest import flown
from tests.results.record.conftest import write_mission

pytestmark = pytest.mark.promise("foreign-files-run-nothing")
CONFIG = """\
cloud:
  estimator: {spy}
  predictor: ./spy.py
  controller: {{name: ../run/spy.py, share: 2.5}}
report:
  metrics: ./spy.py
"""

PACKAGE = Path(ends.__file__).parents[2]


@pytest.fixture
def trace(tmp_path):
    """The path of a file that the code of the run creates."""
    return tmp_path / "trace"


BUILD = "from cloudrc.cloud.predictors.last_sample import build\n"


@pytest.fixture
def spy(trace):
    """A plug-in that creates the file `trace` when it is imported."""
    return f"from pathlib import Path\nPath({str(trace)!r}).touch()\n{BUILD}"


@pytest.fixture
def run(tmp_path, spy):
    """A run whose configuration names a program in its folder."""
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "spy.py").write_text(spy)
    (folder / "config.yaml").write_text(CONFIG.format(spy=folder / "spy.py"))
    write_mission(folder / "mission.mcap", *flown().ends())
    return folder


def test_a_report_executes_nothing_of_the_run(run, trace, monkeypatch):
    monkeypatch.setattr("cloudrc.results.report.page.b64encode", lambda svg: b"")  # a smaller page
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {"error": FIGURES["error"]})
    assert main(["report", str(run)]) == 1
    assert not trace.exists()
    assert json.loads((run / "report.json").read_text())["experiment"] == "config"
    assert "metric spy is not measured" in (run / "report.json").read_text()
    assert f"<dd>{run / 'spy.py'}</dd>" in (run / "report.html").read_text(), (
        "it is named, but not executed"
    )


def test_link_verify_executes_nothing_of_the_run(run, trace):
    controller = PlugIn.model_validate({"name": str(run / "spy.py"), "share": 2.5})
    assert read_experiment(run / "config.yaml").cloud.controller == controller
    experiment = find_experiment(str(run / "config.yaml"), ["link.uplink.delay_ms=200"])
    assert experiment.uplink.delay_ms == 200
    # Its processes get a file that names the same program, and read it in the same way.
    (run / "again.yaml").write_text(dump(experiment))
    assert read_experiment(run / "again.yaml") == experiment
    assert not trace.exists()


@pytest.mark.parametrize(("end", "imports"), [("world", False), ("cloud", True)])
def test_only_cloud_imports_plug_ins(run, trace, monkeypatch, end, imports):
    for name in ("bind", "open_recorder", "open_exporter", "link_monitor"):
        monkeypatch.setattr(ends, name, lambda *words, **more: None)
    (run / "config.yaml").write_text("cloud: {predictor: ./spy.py}")
    (run / "key").write_bytes(b"k" * 32)
    settings = ends.EndSettings(
        config=run / "config.yaml", record=run / "end.mcap", listen=("127.0.0.1", 0),
        key=run / "key", route=run / "route",
    )  # fmt: skip
    ends.open_end(settings, end)
    assert trace.exists() == imports


def modules_with(text):
    """Return the modules that contain a text."""
    return {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        if text in path.read_text()
    }


def test_plug_ins_and_processes_begin_only_where_they_should():
    """All code that does not fly uses `read_experiment`, which imports no plug-in."""
    flies = {"flight/experiment.py", "flight/pod/ends.py"}
    flies |= {f"studies/{name}.py" for name in ("bench", "exercise/checks", "reproduce/flights")}
    flies |= {"cluster/survey.py"}  # values with a plug-in by name; files are not looked at
    assert modules_with("load_experiment(") == flies | {"config/load.py"}
    assert modules_with("sys.executable") == {"flight/machine.py"}


def test_a_new_process_imports_nothing_from_the_working_folder(run, trace, spy, monkeypatch):
    for name in ("cloudrc.py", "yaml.py", "argparse.py"):
        (run / name).write_text(spy)
    monkeypatch.chdir(run)
    done = subprocess.run(interpreter("-m", "cloudrc", "list"), capture_output=True, check=False)
    assert (done.returncode, trace.exists()) == (0, False), done.stderr
    monkeypatch.syspath_prepend(str(run))
    assert "-P" not in interpreter("-m", "cloudrc"), "this process uses that path, too"


def test_a_worker_imports_nothing_from_the_working_folder(run, trace, spy, monkeypatch):
    """A worker imports the modules of its pool before it gets the search path of its parent."""
    (run / "pickle.py").write_text(spy)
    monkeypatch.chdir(run)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    monkeypatch.setattr("cloudrc.flight.trials.workers.usable_cores", lambda: 2)
    assert list(map_in_order(abs, [-1, -2], 2)) == [1, 2]
    assert not trace.exists()
    assert not os.environ.get("PYTHONSAFEPATH")
