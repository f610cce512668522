# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc ros bridge`: a node of ROS 2 beside a flight, which shows and steers the robot."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli.output import print_line, tell
from cloudrc.doors.cli.parser import Options, Parser, add_verbs
from cloudrc.doors.cli.processes import number_argument
from cloudrc.doors.cli.where import api_arguments, given_token, need_run_here
from cloudrc.teleop.client import Api

VERBS = {"bridge": "publish a flight on ROS 2, and take goals and velocities from nodes"}
"""Verb -> its line in the help."""
EPILOG = """\
examples:
  cloudrc ros bridge                     beside 'cloudrc up' in another terminal
  cloudrc ros bridge --run ../runs/latest     a flight of another folder
  cloudrc ros bridge --namespace drone1  /drone1/odom and so on
  cloudrc ros bridge --observe           nodes see the robot, but cannot steer

It needs a ROS 2 with rclpy for this Python. It publishes odom, /tf,
robot_description, cloudrc/mission, guard, scene, path and /diagnostics, takes
goal_pose and cmd_vel, and serves navigate_to_pose and cloudrc/hold, resume,
cancel, estop and acknowledge. It ends with the flight:
docs/ros2-bridge.md describes the topics."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    bridge = add_verbs(parser, VERBS)["bridge"]
    bridge.epilog = EPILOG
    about = "folder of the flying run (default: the only one in flight in this folder)"
    bridge.add_argument("--run", type=Path, metavar="DIR", help=about)
    about = "namespace of topics and services, and prefix of the robot's frames (default: none)"
    bridge.add_argument("--namespace", type=ros_namespace, default="", metavar="NAME", help=about)
    bridge.add_argument(
        "--observe", action="store_true", help="let nodes see the robot, but not steer it"
    )
    bridge.add_argument(
        "--no-navigation", action="store_true", help="leave the action navigate_to_pose to Nav2"
    )
    about = "let base_link move in the frame odom, and odom be a frame in map"
    bridge.add_argument("--rep-105", action="store_true", help=about)
    pod = bridge.add_argument_group("in the container of the chart")
    pod.add_argument("--config", type=Path, metavar="FILE", help="experiment file")
    number_argument(pod)
    about = "folder of 'cloudrc process cloud --records DIR'"
    pod.add_argument("--records", type=Path, metavar="DIR", help=about)
    api_arguments(pod, "the API of teleop; without a token, nodes cannot steer")


class _Flight(NamedTuple):
    """The flight of which the bridge is the node."""

    config: Path  # experiment file
    records: Path  # folder of the sockets of cloud and its readers
    api: Api
    has_api: bool  # whether the API answers the bridge; otherwise nodes cannot steer
    has_ended: Callable[[], bool]
    robot: int | None = None  # number in a fleet


def execute(options: Options) -> None:
    """Be the node of the flight until it ends or the user interrupts."""
    in_pod = (options.config, options.records, options.api, options.token_file)
    flight = _in_pod(options) if any(in_pod) else None
    from cloudrc.doors.bridges.ros2 import require_ros

    packages = "nav_msgs, geometry_msgs, std_msgs, std_srvs, diagnostic_msgs, visualization_msgs"
    require_ros("ros bridge", "bridge", packages)
    flight = flight or _local(options)
    with ExitStack() as stack:
        bridge, reader = _open(stack, options, flight)
        bridge.run(reader, flight.has_ended)
    tell("the flight has ended")


def _local(options: Options) -> _Flight:
    from cloudrc.results.under_way import under_way

    found = need_run_here(options.run, steers=not options.observe, elsewhere=False)
    run, socket = found.folder.resolve(), Path(found.url.removeprefix("unix:"))

    def has_ended() -> bool:
        return not socket.exists() or under_way().get(run) != found.url

    return _Flight(run / "config.yaml", socket.parent, Api(found.url), True, has_ended)


def _in_pod(options: Options) -> _Flight:
    if options.run or not (options.config and options.records and options.api):
        text = "are for the chart's container: give all of them, and no --run"
        raise BadInputError(f"--config, --records and --api {text}")
    token = given_token(options)
    api = Api(options.api, token or str)
    steers = token is not None
    return _Flight(options.config, options.records, api, steers, lambda: False, options.robot)


def _open(stack: ExitStack, options: Options, flight: _Flight) -> tuple[Any, Any]:
    """Open the bridge and the reader of cloud's records; `stack` closes them."""
    from cloudrc.config.load import read_experiment, robot_settings
    from cloudrc.doors.bridges.ros2.bridge import RosBridge, Shown
    from cloudrc.doors.bridges.ros2.description import RobotFrames, covariances, urdf
    from cloudrc.doors.bridges.ros2.requests import RosRequests
    from cloudrc.doors.console.steering import Steering
    from cloudrc.flight.pod.readers import RecordReader
    from cloudrc.results.report.markers import encode_markers, scene_shapes
    from cloudrc.results.report.shapes import read_shapes

    world = read_experiment(str(flight.config), robot_settings(flight.robot)).world
    robot = world.files.robot
    name = options.namespace.strip("/")
    frames = RobotFrames(f"{name}/" if name else "", options.rep_105)
    bodies = read_shapes(world)
    markers = encode_markers(0, scene_shapes(bodies, world.files.scene, frames.prefix))
    description = urdf(world.robot, frames, bodies.robot)
    exactness, navigates = covariances(world.sensors), not options.no_navigation
    sensors = bodies.scanner, bodies.camera
    shown = Shown(frames, markers, description, exactness, navigates, *sensors)

    def tell(text: str) -> None:
        print_line(f"ros: {text}")

    steering = Steering(flight.api)
    requests = RosRequests(
        steering,
        tell,
        planar=robot.planar,
        heading=robot.heading,
        frames=frames,
        observes=options.observe or not flight.has_api,
    )
    bridge = RosBridge(name, shown, steering, requests, tell)
    stack.callback(bridge.close)
    reader = RecordReader(flight.records)
    stack.callback(reader.close)
    if flight.has_api:
        steering.start()
        stack.callback(steering.end_drive)
    return bridge, reader


def ros_namespace(text: str) -> str:
    """Check a namespace; raise a ValueError."""
    from pydantic import TypeAdapter

    from cloudrc.config.schema import RosNamespace

    return TypeAdapter[str](RosNamespace).validate_python(text)
