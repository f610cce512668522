"""cloudrc's own node: it publishes what a controller needs, and takes velocity commands.

Messages cross as CDR bytes, which is faster than rclpy's Python objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import isfinite
from typing import Any, NamedTuple

import rclpy
from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import TimeReference

from cloudrc.drivers.remote import INVALID
from cloudrc.errors import ControllerLostError, MissingPrerequisiteError, to_one_line
from cloudrc.record.live import (
    WORLD,
    decode_stamped_twist,
    decode_twist,
    encode_clock,
    encode_odometry,
    encode_pose,
    encode_span,
)

RELIABLE = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE)
"""QoS of what cloudrc publishes, which all subscriptions match, and of answers in lock step."""
NEWEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS of /clock, and of answers in real time: no message waits for an older one."""
STAMPED, UNSTAMPED = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
"""Types of commands; cloudrc takes the second one in real time only."""
SPANS = ("loop_delay", "horizon")
"""Topics with the delays of a period, from `time_ref` to the stamp of the estimate."""
ASKED_MAX = 1000
"""Number of observations whose answers cloudrc recognises by their stamp."""
WAKE = 0.1
"""Longest time for which the node waits before it lets signals act [s]."""


class RosAnswer(NamedTuple):
    """A velocity command of a user's node."""

    stamp_ns: int | None  # stamp of the estimate that it answers [ns]; None: its type has no stamp
    row: list[float]  # vx, vy, vz [m/s], world frame, yaw rate [rad/s]


class RosNode:
    """cloudrc's node in ROS 2, with a context of its own: others in this process may have theirs.

    Attributes:
        asked: Stamp of a published estimate [ns] -> what `publish` was told about it.
    """

    def __init__(self, namespace: str, *, virtual: bool) -> None:
        """Make the publishers and the subscription below `namespace`, such as "drone1".

        In `virtual` time, publish /clock, and take answers with a stamp only.
        """
        self._virtual = virtual
        self._context = rclpy.Context()
        try:
            rclpy.init(args=[], context=self._context)
        except Exception as error:  # a wrong ROS_DOMAIN_ID, a missing RMW_IMPLEMENTATION
            text = to_one_line(str(error).partition(", at ")[0])
            raise MissingPrerequisiteError(f"ROS 2 does not start here: {text}") from None
        self._node = rclpy.create_node(
            "cloudrc",
            context=self._context,
            namespace=namespace,
            use_global_arguments=False,
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._names = {
            name: f"{self._node.get_namespace().rstrip('/')}/cloudrc/{name}"
            for name in ("estimate", "odometry", "setpoint", "cmd_vel", *SPANS)
        }
        publisher = self._node.create_publisher
        self._estimate = publisher(Odometry, self._names["estimate"], RELIABLE)
        self._odometry = publisher(Odometry, self._names["odometry"], RELIABLE)
        self._setpoint = publisher(PoseStamped, self._names["setpoint"], RELIABLE)
        self._spans = {
            name: publisher(TimeReference, self._names[name], RELIABLE) for name in SPANS
        }
        self._clock = publisher(Clock, "/clock", NEWEST) if virtual else None
        self._waiting = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self._context.handle)
        self._take_type(TwistStamped)
        self.asked: dict[int, Any] = {}
        self._measured_ns = -1
        self._known = ""  # the nodes that have commanded

    def _take_type(self, kind: Any) -> None:
        self._kind = kind
        self._commands = self._node.create_subscription(
            kind,
            self._names["cmd_vel"],
            _ignore,
            RELIABLE if self._virtual else NEWEST,
            raw=True,
        )

    def close(self) -> None:
        """Leave ROS."""
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def publish(self, seen: dict[str, Any], told: Any = None) -> int:
        """Publish an observation; return the stamp of its estimate [ns], which no other one has.

        A prediction may be for the same instant as an earlier one: then its stamp moves by 1 ns.
        """
        stamp_ns = seen["stamp_ns"]
        while stamp_ns in self.asked:
            stamp_ns += 1
        self.asked[stamp_ns] = told
        if len(self.asked) > ASKED_MAX:
            del self.asked[next(iter(self.asked))]
        self.publish_again(seen, stamp_ns)
        return int(stamp_ns)

    def publish_again(self, seen: dict[str, Any], stamp_ns: int) -> None:
        """Publish an observation with the stamp `stamp_ns` [ns]; the estimate comes last.

        A topic that nobody needs to answer is published only if somebody hears it.
        """
        if self._clock is not None and self._clock.get_subscription_count():
            self._clock.publish(encode_clock(seen["now_ns"]))
        measured = seen["measured"]
        is_new = measured and measured[0] != self._measured_ns
        if is_new and self._odometry.get_subscription_count():
            self._measured_ns = measured[0]
            self._odometry.publish(encode_odometry(*measured))
        for name, span in self._spans.items():
            if span.get_subscription_count():
                span.publish(encode_span(stamp_ns, seen[name]))
        self._setpoint.publish(
            encode_pose(stamp_ns, seen["setpoint/position"], seen["setpoint/yaw"])
        )
        names = ("position", "orientation_wxyz", "velocity", "angular_velocity")
        self._estimate.publish(encode_odometry(stamp_ns, *[seen[name] for name in names]))

    def take(self, limit: float) -> RosAnswer | None:
        """Return an answer, or None if none arrives within `limit` [s], at most `WAKE`.

        Raises:
            ControllerLostError: If it is no finite velocity in the frame `world`.
        """
        if (data := self._take()) is None:
            self._waiting.clear_entities()
            self._waiting.add_subscription(self._commands.handle)
            self._waiting.wait(max(0, round(min(limit, WAKE) * 1e9)))
            data = self._take()
        return None if data is None else self._read(data)

    def _take(self) -> bytes | None:
        with self._commands.handle:
            taken = self._commands.handle.take_message(self._kind, True)
        return None if taken is None else taken[0]

    def _read(self, data: bytes) -> RosAnswer:
        if not self._known:
            self.who()
        stamp_ns: int | None = None
        frame = WORLD
        if self._kind is TwistStamped:
            stamp_ns, frame, velocity, yaw_rate = decode_stamped_twist(data)
        else:
            velocity, yaw_rate = decode_twist(data)
        row = [*velocity, yaw_rate]
        if not all(map(isfinite, row)):
            raise self.invalid(f"sends a velocity that is not finite: {row}")
        if frame not in (WORLD, ""):
            raise self.invalid(f"sends a velocity in the frame '{frame}'; cloudrc needs '{WORLD}'")
        return RosAnswer(stamp_ns, row)

    def invalid(self, text: str) -> ControllerLostError:
        """Return the error that the user's node is wrong as `text` says."""
        return ControllerLostError(INVALID, f"{self.who()} {text} ({self._names['cmd_vel']})")

    def who(self) -> str:
        """Name the nodes that command, or have commanded."""
        names = sorted({_name(info) for info in self._publishers()})
        if names:
            self._known = f"node{'s' if len(names) > 1 else ''} {' and '.join(names)}"
        return self._known or "a node"

    def _publishers(self) -> list[Any]:
        """Return the endpoints that command; one without a name has just left, or just come."""
        infos = self._node.get_publishers_info_by_topic(self._names["cmd_vel"])
        return [info for info in infos if "UNKNOWN" not in info.node_name]

    @property
    def is_met(self) -> bool:
        """Whether a node commands, and one hears the estimate."""
        heard = self._estimate.get_subscription_count()
        return bool(heard and self._node.count_publishers(self._names["cmd_vel"]))

    def check(self) -> str:
        """Look for a node that cannot command; return a word if its commands have no stamp.

        Raises:
            ControllerLostError: If its type or QoS is wrong, or if two nodes command.
        """
        topic, infos = self._names["cmd_vel"], self._publishers()
        self.who()
        word = ""
        for info in infos:
            if info.topic_type == UNSTAMPED and not self._virtual:
                if self._kind is not Twist:
                    self._node.destroy_subscription(self._commands)
                    self._take_type(Twist)
                    word = f"node {_name(info)} publishes {UNSTAMPED} on {topic}, which has no "
                    word += "stamp: cloudrc takes it as the answer to the newest estimate"
            elif info.topic_type != STAMPED:
                why = ", which has no stamp" if info.topic_type == UNSTAMPED else ""
                raise self.invalid(f"publishes {info.topic_type}{why}; cloudrc needs {STAMPED}")
        for text in self._clashes(infos, self._commands.qos_profile):
            raise ControllerLostError(INVALID, text)
        if len({_name(info) for info in infos}) > 1:
            raise self.invalid("command both: end all but one; a killed node stays for 20 s")
        return word

    def _clashes(self, infos: list[Any], own: QoSProfile) -> Iterator[str]:
        """Yield sentences about the endpoints of others whose QoS cannot match `own`."""
        for info in infos:
            theirs, publishes = info.qos_profile, info.endpoint_type.name == "PUBLISHER"
            if not (_matches(theirs, own) if publishes else _matches(own, theirs)):
                verb, topic = ("publishes", "cmd_vel") if publishes else ("subscribes", "estimate")
                yield (
                    f"node {_name(info)} {verb} {self._names[topic]} with QoS {_words(theirs)}, "
                    f"which cannot match cloudrc's {_words(own)}"
                )

    def silence(self, limit: float = 0.0) -> str:
        """Say why there was no answer, for `limit` [s] if it is given."""
        domain = f"ROS domain {self._context.get_domain_id()} (ROS_DOMAIN_ID)"
        estimate = self._names["estimate"]
        heard = self._node.get_subscriptions_info_by_topic(estimate)
        if clash := next(self._clashes(heard, RELIABLE), ""):
            return clash
        if not heard:
            who = f"; {self._known} is gone" if self._known else ""
            waited = f" for {limit:.0f} s" if limit >= 1 else ""
            return f"no node subscribes to {estimate} in {domain}{waited}{who}"
        topic = self._names["cmd_vel"]
        if not self._publishers():
            names = " and ".join(sorted({_name(info) for info in heard}))
            return f"no node publishes {topic} in {domain}; {names} subscribes to {estimate}"
        waited = f" within {limit:g} s" if limit else ""
        return f"{self.who()}: no answer on {topic}{waited}"


def _ignore(data: bytes) -> None:
    """Do nothing: `take` takes the messages."""


def _name(info: Any) -> str:
    return f"{info.node_namespace.rstrip('/')}/{info.node_name}"


def _matches(offered: Any, wanted: Any) -> bool:
    """Return whether a subscription with the QoS `wanted` gets what is `offered`.

    rclpy's own check also compares deadlines, which it does not know of cloudrc's side.
    """
    reliable, kept = ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL
    is_reliable = offered.reliability == reliable or wanted.reliability != reliable
    is_kept = offered.durability == kept or wanted.durability != kept
    return bool(is_reliable and is_kept)


def _words(qos: Any) -> str:
    return f"{qos.reliability.name}, {qos.durability.name}"
