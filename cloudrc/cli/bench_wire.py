"""What a datagram costs: layout and seal of telemetry, against the paper's pickled ROS message.

Nothing of cloudrc may import pickle. The one exception is the yardstick, a program for a process of
its own, which unpickles nothing but the constants that it has just pickled itself.
Classes as ROS 1 generates them, an Odometry of the same numbers, as large as a real one (1 kB).
"""

from __future__ import annotations

import subprocess
import timeit
from typing import NamedTuple

from cloudrc.drivers.machine import interpreter

CALLS = 400
REFERENCE_CALLS = 40
"""Fewer: both then run for about a millisecond, in which a busy machine leaves both alone."""
ROUNDS = 60

REFERENCE = """
import pickle, sys, timeit
class Message:
    __slots__ = ()
    def __init__(self, *values):
        self.__setstate__(values)
    def __getstate__(self):
        return [getattr(self, name) for name in self.__slots__]
    def __setstate__(self, state):
        for name, value in zip(self.__slots__, state):
            setattr(self, name, value)
def kind(name, *slots):
    globals()[name] = type(name, (Message,), {"__slots__": slots, "__module__": "__main__"})
kind("Time", "secs", "nsecs")
kind("Header", "seq", "stamp", "frame_id")
kind("Point", "x", "y", "z")
kind("Quaternion", "x", "y", "z", "w")
kind("Pose", "position", "orientation")
kind("Vector3", "x", "y", "z")
kind("Twist", "linear", "angular")
kind("PoseWithCovariance", "pose", "covariance")
kind("TwistWithCovariance", "twist", "covariance")
kind("Odometry", "header", "child_frame_id", "pose", "twist")
covariances = [[0.1 * n + end for n in range(36)] for end in range(2)]
message = Odometry(
    Header(7, Time(1700000000, 123456789), "world"), "base_link",
    PoseWithCovariance(Pose(Point(0.1, 0.2, 0.3), Quaternion(0.1, 0.2, 0.3, 0.9)),
        covariances[0]),
    TwistWithCovariance(Twist(Vector3(0.4, 0.5, 0.6), Vector3(0.7, 0.8, 0.9)),
        covariances[1]))
data = pickle.dumps(message, 4)
calls = int(sys.argv[1])
for _ in sys.stdin:
    cost = timeit.timeit(lambda: pickle.loads(pickle.dumps(message, 4)), number=calls) / calls
    print(len(data), cost, flush=True)
"""


class WireCost(NamedTuple):
    """What one odometry costs on its way, both ends together.

    Attributes:
        sealed: Layout, seal, open and reading [s].
        unsealed: The same without the seal, as in virtual time [s].
        pickled: The paper's way: pickled and unpickled [s].
        size: Of the datagram [bytes].
        pickled_size: Of the pickled message [bytes].
    """

    sealed: float
    unsealed: float
    pickled: float
    size: int
    pickled_size: int

    @property
    def ratio(self) -> float:
        """Sealed to pickled [1]."""
        return self.sealed / self.pickled


def measure_wire(rounds: int = ROUNDS) -> WireCost:
    """Measure all three in turns; of each the fastest round counts."""
    from cloudrc.messages import GuardState, Odometry, Telemetry
    from cloudrc.tunnel import codec
    from cloudrc.tunnel.codec import Direction, Kind
    from cloudrc.tunnel.session import Agreement, Session, UnsealedSession, pair

    odometry = Odometry(1, (0.1, 0.2, 0.3), (0.9, 0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.7, 0.8, 0.9))
    telemetry = Telemetry(1, odometry, 0.0, 2, 3, 0, 1, GuardState.TRACK)
    kind = int(Kind.TELEMETRY)
    unsealed = UnsealedSession(Direction.UPLINK), UnsealedSession(Direction.DOWNLINK)
    for end in unsealed:
        end.begin(1, Agreement(bytes(16), bytes(16)))

    def cost(ends: tuple[Session, Session]) -> float:
        seal, opened = ends[0].seal, ends[1].open
        encode, decode = codec.encode_telemetry, codec.decode_telemetry

        def there() -> None:
            decode(opened(seal(kind, encode(telemetry)))[4])

        return timeit.timeit(there, number=CALLS) / CALLS

    costs = []
    words = interpreter("-c", REFERENCE, str(REFERENCE_CALLS))
    with subprocess.Popen(words, stdin=-1, stdout=-1, text=True) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        for _ in range(rounds):
            child.stdin.write("\n")
            child.stdin.flush()
            size, pickled = child.stdout.readline().split()
            costs.append((cost(pair()), cost(unsealed), float(pickled)))
        child.stdin.close()
    fastest = [min(column) for column in zip(*costs, strict=True)]
    return WireCost(fastest[0], fastest[1], fastest[2], codec.SIZES[kind], int(size))
