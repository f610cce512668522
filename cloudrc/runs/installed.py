"""Hash the code of installed plug-ins, on which the rows of a sweep depend."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import partial
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path

from cloudrc import plugins
from cloudrc.config.load import ResolvedExperiment
from cloudrc.config.overrides import KINDS
from cloudrc.config.reuse import reuse
from cloudrc.config.robot import known_robot
from cloudrc.errors import BadInputError

FILES_MAX, BYTES_MAX = 10_000, 256_000_000
"""Limits of a plug-in's package: hashing takes less than a second or so."""


def installed_code(point: ResolvedExperiment) -> dict[str, str]:
    """Return name -> hash of each installed plug-in that the rows of a point depend on.

    These are the plug-ins that the experiment and the robot name, and all metrics, because each
    flight has all of them. Shipped plug-ins are part of cloudrc's own code.

    Raises:
        BadInputError: If a package is too large to be hashed.
    """
    onboard = known_robot(point.world.robot).onboard
    chosen = [(kind, getattr(point.cloud, key).name) for key, kind in KINDS.items()]
    chosen += [("onboard", onboard.name)] if onboard else []
    chosen += [("metrics", name) for name in _packages_of("metrics")]
    return {f"{kind} {name}": code for kind, name in chosen if (code := plugin_code(kind, name))}


def plugin_code(kind: str, name: str) -> str:
    """Return the hash of an installed plug-in; "" for a shipped one."""
    tops = _packages_of(kind).get(name)
    return reuse(("packages", tops), partial(_hash, tops)) if tops else ""


def package_code(top: str) -> str:
    """Return the hash of the files of a top-level package; of a too large one, of their sizes."""
    try:
        return _hash((top,))
    except BadInputError:
        sizes = sorted((name, path.lstat().st_size) for name, path in _files(top))
        return sha256(repr(sizes).encode()).hexdigest()[:16]


def _packages_of(kind: str) -> dict[str, tuple[str, ...]]:
    return reuse(("packages of", kind), partial(plugins.packages_of, kind))


def _hash(tops: Iterable[str]) -> str:
    """Return the hash of all files of the top-level packages and modules `tops`."""
    total, size = sha256(), 0
    for count, (name, path) in enumerate(sorted(file for top in tops for file in _files(top))):
        try:
            size += path.stat().st_size
            content = b"" if size > BYTES_MAX else path.read_bytes()
        except OSError:  # a flight cannot read this file either: it is other code
            content = b"unreadable"
        if count >= FILES_MAX or size > BYTES_MAX:
            raise BadInputError(
                f"package {name.partition('/')[0]} has plug-ins and more than {FILES_MAX:,} files "
                f"or {BYTES_MAX // 1_000_000} MB, which a sweep cannot compare; move the plug-ins "
                "to a package of their own"
            )
        total.update(f"{name}\n{sha256(content).hexdigest()}\n".encode())
    return total.hexdigest()[:16]


def _files(top: str) -> Iterator[tuple[str, Path]]:
    """Yield name and path of each file of a top-level package or module, but not built ones."""
    try:
        spec = find_spec(top)
    except ValueError:  # a program has put something into sys.modules
        spec = None
    if spec is None:
        return
    if spec.submodule_search_locations is None:
        yield top, Path(spec.origin or "")
    for place in spec.submodule_search_locations or ():
        for folder, below, names in os.walk(place):
            below[:] = [name for name in below if not name.startswith((".", "__pycache__"))]
            for name in names:
                if not name.startswith(".") and not name.endswith(".pyc"):
                    path = Path(folder, name)
                    yield f"{top}/{path.relative_to(place).as_posix()}", path
