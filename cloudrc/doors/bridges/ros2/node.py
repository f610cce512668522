# SPDX-License-Identifier: Apache-2.0

"""cloudrc's own node: it publishes what a controller needs, and takes velocity commands.

Messages cross as CDR bytes, which is faster than rclpy's Python objects.
"""

from __future__ import annotations

from math import isfinite
from typing import Any, NamedTuple

from geometry_msgs.msg import PoseStamped, Twist, TwistStamped
from nav_msgs.msg import Odometry
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.type_support import check_for_type_support
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import TimeReference

from cloudrc.base.errors import ControllerLostError
from cloudrc.doors.bridges.ros2.own_node import (
    LINGERS,
    NEWEST,
    QUEUED,
    RELIABLE,
    OwnNode,
    clash,
    known,
    name_of,
)
from cloudrc.flight.pod.transports.remote import INVALID
from cloudrc.results.record.live import (
    WORLD,
    decode_stamped_twist,
    decode_twist,
    encode_clock,
    encode_odometry,
    encode_pose,
    encode_span,
)

STAMPED, UNSTAMPED = "geometry_msgs/msg/TwistStamped", "geometry_msgs/msg/Twist"
"""Types of commands; cloudrc takes the second one in real time only."""
SPANS = ("loop_delay", "horizon")
"""Topics with the delays of a period, from `time_ref` to the stamp of the estimate."""
ASKED_MAX = 1000
"""Number of observations whose answers cloudrc recognises by their stamp."""
WAKE = 0.1
"""Longest time for which the node waits before it lets signals act [s]."""


def load_messages() -> None:
    """Load the code of all messages; raise an exception if it is not for this ROS or Python."""
    for kind in (Odometry, PoseStamped, TimeReference, TwistStamped, Twist, Clock):
        check_for_type_support(kind)


class RosAnswer(NamedTuple):
    """A velocity command of a user's node."""

    stamp_ns: int | None  # stamp of the estimate that it answers [ns]; None: its type has no stamp
    row: list[float]  # vx, vy, vz [m/s], world frame, yaw rate [rad/s]


class RosNode(OwnNode):
    """The node that publishes what a controller needs, and takes its velocity commands.

    Attributes:
        asked: Stamp of a published estimate [ns] -> what `publish` was told about it.
    """

    def __init__(self, namespace: str, *, virtual: bool) -> None:
        """Make the publishers and the subscription below `namespace`, such as "drone1".

        In `virtual` time, publish /clock, and take answers with a stamp only.
        """
        super().__init__("cloudrc", namespace)
        self._virtual = virtual
        self._names = {
            name: self.topic(name)
            for name in ("estimate", "odometry", "setpoint", "cmd_vel", *SPANS)
        }
        publisher = self.node.create_publisher
        self._estimate = publisher(Odometry, self._names["estimate"], RELIABLE)
        self._odometry = publisher(Odometry, self._names["odometry"], RELIABLE)
        self._setpoint = publisher(PoseStamped, self._names["setpoint"], RELIABLE)
        self._spans = {
            name: publisher(TimeReference, self._names[name], RELIABLE) for name in SPANS
        }
        self._clock = publisher(Clock, "/clock", NEWEST) if virtual else None
        self._waiting = rclpy_implementation.WaitSet(1, 0, 0, 0, 0, 0, self.context.handle)
        self._take_type(TwistStamped)
        self.asked: dict[int, Any] = {}
        self._measured_ns = -1
        self._known = ""  # the nodes that have commanded

    def _take_type(self, kind: Any) -> None:
        self._kind = kind
        self._commands = self.node.create_subscription(
            kind,
            self._names["cmd_vel"],
            _ignore,
            QUEUED if self._virtual else NEWEST,
            raw=True,
        )

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
        """Publish an observation with the stamp `stamp_ns` [ns]; the estimate comes last."""
        if self._clock is not None:
            self._clock.publish(encode_clock(seen["now_ns"]))
        measured = seen["measured"]
        if measured and measured[0] != self._measured_ns:
            self._measured_ns = measured[0]
            self._odometry.publish(encode_odometry(*measured))
        for name, span in self._spans.items():
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
        stamp_ns, frame = None, WORLD
        try:
            if self._kind is Twist:
                velocity, yaw_rate = decode_twist(data)
            else:
                stamp_ns, frame, velocity, yaw_rate = decode_stamped_twist(data)
        except Exception:  # rosbags raises what it meets
            text = f"sends {len(data)} bytes that are no {self._kind.__name__} of this ROS"
            raise self.invalid(text) from None
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
        names = sorted({name_of(info) for info in self._publishers()})
        if names:
            self._known = f"node{'s' if len(names) > 1 else ''} {' and '.join(names)}"
        return self._known or "a node"

    def _publishers(self) -> list[Any]:
        """Return the endpoints that command."""
        return known(self.node.get_publishers_info_by_topic(self._names["cmd_vel"]))

    @property
    def is_met(self) -> bool:
        """Whether a node commands, and one hears the estimate."""
        heard = self._estimate.get_subscription_count()
        return bool(heard and self.node.count_publishers(self._names["cmd_vel"]))

    def check(self, *, crowded: bool = False) -> str:
        """Look for a node that cannot command; return a word if its commands have no stamp.

        `crowded` is whether estimates get two answers, as from two nodes with one name.

        Raises:
            ControllerLostError: If its type or QoS is wrong, or if two nodes command.
        """
        topic, infos = self._names["cmd_vel"], self._publishers()
        self.who()
        self._check_alone()
        names = sorted(map(name_of, infos))
        if len(set(names)) > 1 or (crowded and len(names) > 1):
            text = f"nodes {' and '.join(names)} command both ({topic})"
            raise ControllerLostError(INVALID, f"{text}: end all but one; {LINGERS}")
        word, kinds = "", sorted({info.topic_type for info in infos})
        if kinds == [UNSTAMPED] and not self._virtual:
            if self._kind is not Twist:
                self.node.destroy_subscription(self._commands)
                self._take_type(Twist)
                word = f"{self._known} publishes {UNSTAMPED} on {topic}, which has no stamp: "
                word += "cloudrc takes it as the answer to the newest estimate"
        elif kinds not in ([], [STAMPED]):
            raise self.invalid(f"publishes {' and '.join(kinds)}; cloudrc needs {STAMPED}")
        for info in infos:
            if text := clash(info, self._commands.qos_profile, topic):
                raise ControllerLostError(INVALID, text)
        self._check_hears(set(names))
        return word

    def _check_alone(self) -> None:
        """Raise a ControllerLostError if another node publishes the estimate."""
        estimate = self._names["estimate"]
        names = [name_of(info) for info in known(self.node.get_publishers_info_by_topic(estimate))]
        if len(names) > 1:
            raise ControllerLostError(
                INVALID,
                f"node {' and '.join(names)} publishes {estimate} in {self.domain}: give each "
                f"flight a domain or a namespace of its own; {LINGERS}",
            )

    def _check_hears(self, names: set[str]) -> None:
        """Raise a ControllerLostError if the QoS of what the nodes `names` hear cannot match."""
        for name in ("estimate", "setpoint"):
            topic = self._names[name]
            for info in known(self.node.get_subscriptions_info_by_topic(topic)):
                if name_of(info) in names and (text := clash(info, RELIABLE, topic)):
                    raise ControllerLostError(INVALID, text)

    def silence(self, limit: float = 0.0) -> str:
        """Say why there was no answer, for `limit` [s] if it is given."""
        estimate = self._names["estimate"]
        heard = known(self.node.get_subscriptions_info_by_topic(estimate))
        for info in heard:
            if text := clash(info, RELIABLE, estimate):
                return text
        if not heard:
            who = f"; {self._known} is gone" if self._known else ""
            waited = f" for {limit:.0f} s" if limit >= 1 else ""
            return f"no node subscribes to {estimate} in {self.domain}{waited}{who}"
        topic = self._names["cmd_vel"]
        if not self._publishers():
            names = " and ".join(sorted({name_of(info) for info in heard}))
            return f"no node publishes {topic} in {self.domain}; {names} subscribes to {estimate}"
        waited = f" within {limit:g} s" if limit else ""
        return f"{self.who()}: no answer on {topic}{waited}"


def _ignore(data: bytes) -> None:
    """Do nothing: `take` takes the messages."""
