# SPDX-License-Identifier: Apache-2.0

"""Write a page for each shipped robot and mission: picture, command, facts and limits.

The facts come from the files of the package and from the compiled models. `make docs` writes the
pages, `make pictures` their pictures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

from cloudrc.base.outside.document import read_document
from cloudrc.config import shipped
from cloudrc.config.problems import validate
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import RobotFiles
from cloudrc.config.schema import MissionConfig
from cloudrc.config.world import ResolvedWorld
from cloudrc.robots.build import build_robot
from cloudrc.robots.check import SCENE, read_facts
from tools.markdown import table

DOCS = Path(__file__).resolve().parents[1] / "docs"
OWN_FLIGHTS: dict[str, dict[str, tuple[str, dict[str, str]]]] = {
    "robot": {"pelican": ("paper", {}), "rover": ("pillars", {})},
    "mission": {
        "carrot": ("fast", {}),
        "legs": ("fast", {"world.robot": "x2", "mission": "legs"}),
        "pillars": ("pillars", {}),
        "pipes": ("paper", {}),
        "slalom": ("pillars", {"world.robot": "x2", "mission": "slalom"}),
        "steps": ("steps", {}),
    },
}
"""Kind with pages -> name -> experiment and settings of a flight that shows it, if not the usual
ones."""
HEADINGS = {
    "free": "it turns at the commanded yaw rate; waypoints may have a yaw",
    "fixed": "its onboard controller holds the yaw at 0; waypoints have no yaw",
    "velocity": "it turns towards its velocity; waypoints have no yaw",
}
STOPS = {"land": "it descends and switches off at touch-down", "brake": "it brakes to rest"}


def flight_of(kind: str, name: str) -> tuple[str, dict[str, str]]:
    """Return experiment and settings of a flight that shows a robot or a mission."""
    usual = ("steps", {"world.robot": name}) if kind == "robot" else ("paper", {"mission": name})
    return OWN_FLIGHTS[kind].get(name, usual)


def pages() -> dict[Path, str]:
    """Return the page of each shipped robot and mission: file -> text."""
    bodies: dict[str, Callable[[str], str]] = {"robot": _robot, "mission": _mission}
    found = {}
    for kind, body in bodies.items():
        for name in shipped.names(kind):
            head = f"# The {kind} `{name}`\n\n{shipped.describe(kind, name)}.\n"
            picture = f"![{shipped.describe(kind, name)}]({name}.webp)\n"
            experiment, settings = flight_of(kind, name)
            flags = "".join(f" --set {key}={value}" for key, value in settings.items())
            command = f"```bash\ncloudrc run {experiment} --mode virtual{flags}\n```\n"
            made = "<!-- made by `make docs`; the picture by `make pictures` -->\n"
            text = "\n".join([made, head, picture, command, body(name)])
            found[DOCS / f"{kind}s" / f"{name}.md"] = text
    return found


def link(kind: str, name: str) -> str:
    """Return a link from a page of docs/ to the page of a robot or a mission."""
    return f"[`{name}`]({kind}s/{name}.md)"


def _robot(name: str) -> str:
    world = ResolvedWorld(robot=name, scene=SCENE)
    robot = world.files.robot
    model = build_robot(world, ResolvedGuard.model_validate({})).simulator.model
    facts = read_facts(world, model)
    folder = f"../../cloudrc/robots/{name}"
    return "\n".join(
        [
            table("fact | value", _facts(robot, facts)),
            "## Limits\n",
            table("limit | value", _limits(robot)),
            f"Its files: [robot.yaml]({folder}/robot.yaml), [robot.xml]({folder}/robot.xml).\n"
            f"`cloudrc check {name}` moves it and measures more.\n"
            "A robot of your own: [robot.md](../robot.md).\n",
        ]
    )


def _facts(robot: RobotFiles, facts: dict[str, Any]) -> Iterator[tuple[str, str]]:
    onboard = Path(robot.onboard.name).name
    yield "mass", f"{facts['mass_kg']:.3g} kg"
    yield "radius of the ball that contains it", f"{facts['hull_m']:.3g} m"
    yield "actuators", ", ".join(f"`{each}`" for each in facts["actuators"])
    if ratio := facts.get("thrust_to_weight"):
        yield "largest thrust over weight", f"{ratio:.2g}"
    yield "onboard controller", f"[`{onboard}`](../experiment.md#onboard-controllers)"
    yield "tunings (`world.tuning`)", ", ".join(f"`{each}`" for each in robot.tunings) or "none"
    sensors = (f"`{key}` [{unit}]" for key, unit in facts["sensors"].items())
    yield "own sensors", ", ".join(sensors) or "none"
    yield "touches with", f"`{robot.probe}`" if robot.probe else "any part"


def _limits(robot: RobotFiles) -> Iterator[tuple[str, str]]:
    speed, limits = robot.guard.speed_max_mps, robot.guard
    yield "speed", f"{speed:g} m/s" if speed else "such that it stops before the fence"
    yield "acceleration", f"{limits.acceleration_max_mps2:g} m/s²"
    yield "braking that the guard relies on", f"{limits.braking_mps2:g} m/s²"
    yield "height", "it stays on the ground" if robot.planar else "inside the fence"
    yield "heading", HEADINGS[robot.heading]
    yield "landing", STOPS[limits.stop or "land"]


def _mission(name: str) -> str:
    path = shipped.FOLDERS["mission"] / f"{name}.yaml"
    mission = validate(read_document(path, name), MissionConfig, name)
    rows = (
        (number, _numbers(point.position_m), f"{point.tolerance_m:g}", f"{point.dwell_s:g}")
        for number, point in enumerate(mission.waypoints, 1)
    )
    points = table("waypoint | x, y, z [m] | tolerance [m] | dwell [s]", rows)
    return "\n".join(
        [
            *([points] if mission.waypoints else []),
            "## Limits\n",
            table("limit | value", _conditions(mission)),
            f"Its file: [{name}.yaml](../../cloudrc/config/missions/{name}.yaml). "
            "A mission of your own: [scene.md](../scene.md).\n",
        ]
    )


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(f"{each:g}" for each in values)


def _conditions(mission: MissionConfig) -> Iterator[tuple[str, str]]:
    yield "start", "the spawn of the scene" if mission.start == "spawn" else "where the robot is"
    if steps := mission.steps:
        yield "steps", f"{steps.count}, one every {steps.period_s:g} s; the seed decides where"
        centre, reach = _numbers(steps.centre_m), _numbers(steps.range_m)
        yield "where", f"up to ({reach}) m from ({centre}) m"
    if mission.carrot:
        yield (
            "setpoint",
            (
                f"moves at up to {mission.carrot.speed_mps:g} m/s and "
                f"{mission.carrot.acceleration_mps2:g} m/s²"
            ),
        )
    if mission.touch:
        yield "touches", f"`{mission.touch.body}` at up to {mission.touch.speed_max_mps:g} m/s"
    touch = "any other touch" if mission.touch else "any touch"
    yield "fails", f"at {touch}, and at the [time limit](../experiment.md#criteria)"
