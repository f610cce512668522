# SPDX-License-Identifier: Apache-2.0

"""The programs of docs/tracking.md log what an evaluation has found: with small fakes."""

import runpy
import sys
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace

import pytest

from tests.support.pages import blocks

NUMBERS = {(0, "no network/success"), (0, "newest/success"), (40, "newest/success")}


class Run:
    """Notes the numbers that the services get."""

    def __init__(self):
        self.numbers, self.settings, self.files = set(), {}, []

    def take(self, numbers, step):
        self.numbers |= {(step, name) for name in numbers if name.endswith("success")}


def weights_and_biases(run):
    def log(found):
        run.take(found, found.get("rtt_ms"))
        run.files += [each.path for each in found.values() if isinstance(each, Image)]

    @contextmanager
    def init(project, config):
        run.settings = config
        yield SimpleNamespace(log=log, define_metric=lambda *_, step_metric: None,
                              log_artifact=lambda each: run.files.append(each.folder))  # fmt: skip

    class Image:
        def __init__(self, path):
            self.path = path

    class Artifact:
        def __init__(self, name, type):
            pass

        def add_dir(self, folder):
            self.folder = folder

    return {"wandb": {"init": init, "Image": Image, "Artifact": Artifact}}


def mlflow(run):
    @contextmanager
    def start_run(run_name):
        yield

    return {
        "mlflow": {
            "start_run": start_run,
            "set_experiment": lambda name: None,
            "log_params": run.settings.update,
            "log_metrics": run.take,
            "log_artifacts": run.files.append,
        }
    }


def tensorboard(run):
    class SummaryWriter:
        def __init__(self, folder):
            run.files.append(folder)

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def add_scalar(self, name, value, step):
            run.take({name: value}, step)

        def add_text(self, name, text):
            run.settings["env"] = "CartPole-v1" if "CartPole-v1" in text else ""

    parts = ("torch", "torch.utils", "torch.utils.tensorboard")
    return {part: {"SummaryWriter": SummaryWriter} for part in parts}


@pytest.mark.parametrize(
    ("number", "fake"), [(1, weights_and_biases), (2, mlflow), (3, tensorboard)]
)
def test_a_program_logs_the_numbers_of_each_condition(
    number, fake, law, tmp_path, monkeypatch, evaluate
):
    monkeypatch.chdir(tmp_path)
    words = "--rtt 0,40 --seeds 1 --success-at 500 --max-steps 9 --out runs/law --policy".split()
    evaluate(*words, law())
    programs = blocks("tracking", "python")
    (tmp_path / "outcomes.py").write_text(programs[0])
    (tmp_path / "log.py").write_text(programs[number])
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "outcomes", raising=False)
    run = Run()
    for name, content in fake(run).items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(tmp_path / "log.py"))
    del sys.modules["outcomes"]
    assert run.numbers == NUMBERS
    assert run.settings["env"] == "CartPole-v1"
    assert any("law" in each for each in run.files)
