"""Names and versions of installed plug-ins, on which the rows of a sweep depend."""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec
from pathlib import Path

from cloudrc import plugins
from cloudrc.config.overrides import KINDS
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.robot import known_robot
from cloudrc.outside.code import is_installed
from cloudrc.outside.reuse import reuse
from cloudrc.runs.own_files import hash_of_module


def installed_code(point: ResolvedExperiment) -> dict[str, str]:
    """Return name -> version of each installed plug-in that the rows of a point depend on.

    These are the plug-ins that the experiment and the robot name, and all metrics, because each
    flight has all of them. Shipped plug-ins are part of cloudrc's own code.
    """
    onboard = known_robot(point.world.robot).onboard
    chosen = [(kind, getattr(point.cloud, key).name) for key, kind in KINDS.items()]
    chosen += [("onboard", onboard.name)]
    chosen += [("metrics", name) for name in plugins.installed("metrics")]
    return {f"{kind} {name}": code for kind, name in chosen if (code := plugin_code(kind, name))}


def plugin_code(kind: str, name: str) -> str:
    """Return the version of an installed plug-in, as `module_code` does; "" for a shipped one."""
    entry = plugins.installed(kind).get(name)
    return reuse(("package", kind, name), partial(module_code, entry.module)) if entry else ""


def module_code(module: str) -> str:
    """Return the names and versions of the packages that have installed a module.

    An editable package, whose version stays while its code changes, also has the hash of the
    module's file and of the modules that this file imports.
    """
    versions = plugins.versions_of(module.partition(".")[0])
    spec = find_spec(module)
    if spec is not None and spec.origin is not None and not is_installed(spec.origin):
        versions.append(hash_of_module(module, Path(spec.origin)))
    return ", ".join(versions)
