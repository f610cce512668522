# SPDX-License-Identifier: Apache-2.0

"""Check a plug-in before it flies: the contract of its kind, and a flight or an episode."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from cloudrc.base import plugins
from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.base.outside.code import calling, load_file
from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.requirements import SIM, require
from cloudrc.config.choice import PlugIn
from cloudrc.config.overrides import build_plugin
from cloudrc.config.robot import RobotFacts, facts
from cloudrc.config.world import ResolvedWorld
from cloudrc.results.metrics.measure import find
from cloudrc.studies.check import tried
from cloudrc.studies.check.contract import CHECKS

KINDS = ("estimators", "predictors", "perceptions", "executors", "controllers", "metrics")
"""Kinds that are checked. An estimator, too, has the method by which a controller is known."""
ONBOARD = "is an onboard controller; it is checked with its robot: cloudrc check FOLDER"


def check_plugin(name: str, kind: str | None = None) -> dict[str, Any]:
    """Check a plug-in; return its kind, and what was checked, as values for JSON.

    The first check that fails is the last one.

    Args:
        name: Path of a file, or name of a plug-in that is shipped or installed.
        kind: One of `KINDS`; None: by the methods of the plug-in in the file.

    Raises:
        BadInputError: If it cannot be imported, or is no plug-in.
    """
    kind = kind or find_kind(name)
    require("the check of a plug-in", ("gym",) if kind == "executors" else SIM)
    _find(kind, name)
    if plugins.is_path(name):
        name = str(Path(name).resolve())
    rows = list[dict[str, Any]]()
    for what, check in _checks(kind, name):
        try:
            with calling(what, keep=MissingPrerequisiteError):
                found = check()
        except BadInputError as error:
            why = str(error).removeprefix(f"{what}: ")
            rows.append({"check": what, "ok": False, "found": why})
            break
        rows.append({"check": what, "ok": True, "found": found or ""})
    return {"kind": plugins.one(kind), "ok": rows[-1]["ok"], "checks": rows}


def find_kind(file: str) -> str:
    """Return the kind of the plug-in in a file: of several, the first of `KINDS`.

    Raise a BadInputError if it is none.
    """
    if not Path(file).is_file():
        raise BadInputError(f"{file}: there is no such file")
    with calling(f"{file} cannot be imported"):
        found = plugins.Found(load_file(Path(file), look=True))
    if isinstance(found.get("UNIT"), str) and callable(found.get("measure")):
        return "metrics"
    with naming(file):
        if not callable(found.builder):
            text = "is no plug-in: it has neither build() nor UNIT and measure()"
            raise InvalidValueError(f"{text}; docs/plugins.md says what it needs")
        with calling("build() failed"):
            taken = inspect.signature(found.builder).parameters
            if "model" in taken:
                raise InvalidValueError(ONBOARD)
            made = found.builder(**({"robot": _robot()} if "robot" in taken else {}))
        for kind in KINDS:
            if callable(getattr(made, plugins.METHODS.get(kind, ("",))[0], None)):
                return kind
        text = f"build() returned {type(made).__name__}, which has the methods of no plug-in"
        raise InvalidValueError(f"{text}; name its kind with --as")


def as_text(document: Mapping[str, Any]) -> str:
    """Format the result of `check_plugin` for people."""
    return "\n".join(map(_as_line, document["checks"]))


def _as_line(row: Mapping[str, Any]) -> str:
    found = f": {row['found']}" if row["found"] else ""
    return f"{'ok' if row['ok'] else 'fails'}: {row['check']}{found}"


def _find(kind: str, name: str) -> None:
    """Raise a BadInputError if there is no such plug-in, or if its file cannot be imported."""
    if kind == "metrics":
        find(name, look=True)
        return
    if kind == "executors":
        importlib.import_module("cloudrc.gym.executors")  # it tells where those of cloudrc are
    plugins.find(kind, name)


def _robot() -> RobotFacts:
    """Return what cloud knows of a robot, for plug-ins that want it."""
    world = ResolvedWorld()
    return facts(world.files.robot, world, None)


def _checks(kind: str, name: str) -> Iterator[tuple[str, Callable[[], str | None]]]:
    """Yield what is checked, in words, and the check, which may return what it found."""
    if kind == "metrics":
        yield "UNIT and measure()", lambda: find(name).meaning
        yield "measure() of a flight", partial(tried.measure, name)
        return
    if kind == "executors":
        yield f"two equal episodes over {tried.LINK}", partial(tried.play, name)
        return

    def build() -> Any:
        return build_plugin(kind, PlugIn(name=name), robot=_robot())

    yield "build()", lambda: type(build()).__name__
    for what, check in CHECKS[kind]:
        yield what, partial(check, build)
    takes = build().takes if kind == "perceptions" else ""
    yield f"a flight over {tried.LINK}", partial(tried.fly, kind, name, takes)
