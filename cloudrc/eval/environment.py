"""Hash the code and the files behind an environment, as far as its class and arguments tell."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Any

import gymnasium

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.eval.setup import EvalSetup
from cloudrc.outside.code import OWN, is_installed
from cloudrc.plugins import is_path
from cloudrc.runs.grid import everything_of
from cloudrc.runs.installed import module_code
from cloudrc.runs.own_files import hash_all, hash_of_module, hashes


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
    """Return the hash of all that is known to decide how the environment of a setup behaves.

    It is that of the modules of its classes, of the files in its arguments, and of the experiment
    of a testbed's robot.
    """
    found = dict[str, Any]()
    for name in sorted(_modules(env, setup)):
        top = name.partition(".")[0]
        file = getattr(sys.modules.get(name), "__file__", None)
        if file is None or top == OWN or top in sys.stdlib_module_names:
            continue
        if not is_installed(file):
            found[name] = hash_of_module(name, Path(file))
        elif top not in found:
            found[top] = module_code(top)
    for path in _files_in(dict(setup.env_args)):
        found[path] = hashes(path)
    experiment = getattr(env.unwrapped, "experiment", None)
    if isinstance(experiment, ResolvedExperiment):
        found["experiment"] = everything_of(experiment, hash_all(experiment)).decode()
    return sha256(json.dumps(found, sort_keys=True).encode()).hexdigest()


def _modules(env: gymnasium.Env[Any, Any], setup: EvalSetup) -> set[str]:
    """Return the names of the modules that register, make and define an environment.

    The packages that contain them are also modules.
    """
    module, colon, _ = find_module(setup).partition(":")
    names = {module} if colon else set[str]()
    entry: Any = getattr(env.spec, "entry_point", None)
    names.add(
        entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    )
    layer: gymnasium.Env[Any, Any] = env
    while isinstance(layer, gymnasium.Wrapper):
        names |= {each.__module__ for each in type(layer).__mro__}
        layer = layer.env
    names |= {each.__module__ for each in type(layer).__mro__}
    parts = [name.split(".") for name in names]
    return {".".join(each[:count]) for each in parts for count in range(1, len(each) + 1)}


def _files_in(value: Any) -> Iterator[str]:
    """Yield each text in the value of an argument that is the path of a file."""
    if isinstance(value, str) and os.path.isfile(value):
        yield value
    elif isinstance(value, Mapping):
        yield from _files_in([*value.values()])
    elif isinstance(value, list):
        for each in value:
            yield from _files_in(each)
