# SPDX-License-Identifier: Apache-2.0

"""Hash the code and the files behind an environment, as far as its class and arguments tell."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import gymnasium

from cloudrc.base.outside.code import OWN
from cloudrc.base.plugins import is_path
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.own_files import hashes
from cloudrc.flight.trials.fingerprint import code_of, experiment_facts, fingerprint
from cloudrc.gym.step import layers
from cloudrc.gym.values import leaves
from cloudrc.studies.eval.setup import EvalSetup


def find_module(setup: EvalSetup) -> str:
    """Return the name of the environment for gymnasium: with a module, not the path of a file.

    Let Python find modules beside the environment, beside the policy and in the working folder,
    too. They come last, so that no file there hides a package.
    """
    module, colon, name = setup.env.rpartition(":")
    for file in (module, setup.policy, ""):
        folder = os.path.dirname(os.path.join(os.getcwd(), file))
        if folder not in sys.path:
            sys.path.append(folder)
    return f"{Path(module).stem}:{name}" if colon and is_path(module) else setup.env


def environment_code(env: gymnasium.Env[Any, Any], setup: EvalSetup) -> str:
    """Return the fingerprint of all that is known to decide how the environment of a setup behaves.

    It is that of the modules of its classes, of the files in its arguments, and of the experiment
    of a testbed's robot.
    """
    found: dict[str, Any] = {
        name: code_of(name) for name in sorted(_modules(env, setup)) if _is_foreign(name)
    }
    for value in leaves(dict(setup.env_args)):
        if isinstance(value, str) and os.path.isfile(value):
            found[value] = hashes(value)
    experiment = getattr(env.unwrapped, "experiment", None)
    if isinstance(experiment, ResolvedExperiment):
        found["experiment"] = experiment_facts(experiment)
    return fingerprint(found)


def _is_foreign(name: str) -> bool:
    """Return whether a module is neither cloudrc's nor Python's."""
    file = getattr(sys.modules.get(name), "__file__", None)
    return file is not None and name.partition(".")[0] not in (OWN, *sys.stdlib_module_names)


def _modules(env: gymnasium.Env[Any, Any], setup: EvalSetup) -> set[str]:
    """Return the names of the modules that register, make and define an environment.

    The packages that contain them are also modules.
    """
    entry: Any = getattr(env.spec, "entry_point", None)
    made = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    names = {find_module(setup).rpartition(":")[0], made}
    names |= {each.__module__ for layer in layers(env) for each in type(layer).__mro__}
    parts = [name.split(".") for name in names]
    return {".".join(each[:count]) for each in parts for count in range(1, len(each) + 1)}
