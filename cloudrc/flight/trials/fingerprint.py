# SPDX-License-Identifier: Apache-2.0

"""Name what a row depends on: equal fingerprints mean equal rows.

That is the code of cloudrc, the settings, the person's own files, and the installed plug-ins.
"""

from __future__ import annotations

import json
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from cloudrc.base import plugins, source
from cloudrc.base.outside.code import is_installed
from cloudrc.base.outside.reuse import reuse
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.own_files import hash_all, hash_of_module


def fingerprint(*facts: Any) -> str:
    """Return the hash of facts and of cloudrc's own code: 16 hexadecimal digits."""
    everything = [source.code_hash(), reuse(("installed",), installed_plugins), *facts]
    text = json.dumps(everything, sort_keys=True, default=str)
    return sha256(text.encode()).hexdigest()[:16]


def key_of(condition: str, seed: int) -> str:
    """Return the key of a trial with the fingerprint of its condition: 16 hexadecimal digits."""
    return sha256(f"{condition} seed {seed}".encode()).hexdigest()[:16]


def experiment_facts(experiment: ResolvedExperiment) -> list[Any]:
    """Return all that decides a flight, except its seed and what `fingerprint` adds itself."""
    values = experiment.model_dump(mode="json", exclude={"seed"})
    return [values, hash_all(experiment)]


def installed_plugins() -> dict[str, str]:
    """Return kind and name of each installed plug-in -> its code, as `code_of` tells it."""
    return {
        f"{kind} {name}": code_of(entry.module)
        for kind in plugins.PACKAGES
        for name, entry in plugins.installed(kind).items()
    }


def code_of(module: str) -> str:
    """Return name and version of the package that has installed a module.

    A module of the person's own, or of a package installed in place (`pip install -e`), whose
    version stays while its code changes, also has the hash of its files.
    """
    versions = plugins.versions_of(module.partition(".")[0])
    spec = find_spec(module)
    if spec is not None and spec.origin is not None and not is_installed(spec.origin):
        versions.append(hash_of_module(module, Path(spec.origin)))
    return ", ".join(versions)
