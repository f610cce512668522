# SPDX-License-Identifier: Apache-2.0

"""Hash the user's files that an experiment names, and find those that changed since a flight."""

from __future__ import annotations

import json
import os
import sys
from hashlib import file_digest, sha256
from pathlib import Path

from cloudrc.base.files import read_json
from cloudrc.base.outside import code
from cloudrc.base.outside.reuse import reuse
from cloudrc.config.load import read_experiment
from cloudrc.config.resolved import ResolvedExperiment, absolute_paths, local_files
from cloudrc.config.robot import files_of
from cloudrc.physics.geometry.model_files import model_files
from cloudrc.results.report.document import ENVIRONMENT_FILE, FILES

DIGITS = 12
"""Number of hexadecimal digits of a hash."""


def hashes(path: str) -> list[tuple[str, str]]:
    """Return the paths and hashes of a file, and of the files that it needs.

    A plug-in needs the modules that it imports. A robot or scene needs the files that it names.
    """
    needs = model_files if path.endswith(".xml") else code.sources
    return reuse(
        ("hashes", path),
        lambda: [(str(file), _hash_of(file)) for file in needs(Path(path))],
    )


def _hash_of(file: Path) -> str:
    with file.open("rb") as stream:  # a data set may be larger than the memory
        return file_digest(stream, "sha256").hexdigest()


def hash_all(experiment: ResolvedExperiment) -> dict[str, str]:
    """Return the path of each of the user's files on which a flight depends -> its hash."""
    values = experiment.model_dump(mode="json")
    named = [*local_files(values).values()] if '"/' in json.dumps(values) else []
    named += map(str, files_of(experiment.world.robot, experiment.robot))
    return {file: each for path in named for file, each in hashes(path)}


def hash_of(files: list[Path]) -> str:
    """Return the hash of names and contents of files."""
    total = sha256()
    for path in sorted(files):
        total.update(f"{path.name}\n{sha256(path.read_bytes()).hexdigest()}\n".encode())
    return total.hexdigest()


def hash_of_module(name: str, file: Path) -> str:
    """Return the hash of the `file` of a module and of the local modules that it imports."""
    depth = name.count(".") + (file.stem == "__init__")
    others = [each for each in sys.path if os.path.isdir(each) and not code.is_installed(each)]
    root = [*file.parents][: depth + 1][-1]  # of the top-level package
    return hash_of(code.sources(file, [str(root), *others]))


def hash_files(experiment: ResolvedExperiment) -> dict[str, str]:
    """Return the dotted key of each of the user's files -> hash of the file and what it needs."""
    named = {key: [path] for key, path in local_files(experiment.model_dump(mode="json")).items()}
    if robot := files_of(experiment.world.robot, experiment.robot):
        named["world.robot"] = [str(file) for file in robot]
    return {key: _hash(paths) for key, paths in named.items()}


def _hash(paths: list[str]) -> str:
    contents = sorted({content for path in paths for _, content in hashes(path)})
    return sha256("".join(contents).encode()).hexdigest()[:DIGITS]


def describe_changes(name: str, experiment: ResolvedExperiment) -> str:
    """Say which files of a run have changed since its flight; "" if none has.

    `name` is that of the experiment, such as the path of the config.yaml of a run. Files that the
    `experiment` does not take from there do not count.
    """
    config = Path(name)
    flown = read_json(config.with_name(ENVIRONMENT_FILE)).get(FILES)
    if not flown:
        return ""
    before = absolute_paths(read_experiment(config, flown=True).model_dump(mode="json"))
    now = absolute_paths(experiment.model_dump(mode="json"))
    changes = [
        f"{key} (then {flown[key]}, now {each})"
        for key, each in hash_files(experiment).items()
        if key in flown and before.get(key) == now.get(key) and flown[key] != each
    ]
    if not changes:
        return ""
    return f"changed since the flight of {config.parent}: {', '.join(changes)}; results may differ"
