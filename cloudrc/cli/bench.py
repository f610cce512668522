"""`cloudrc bench`: measure what the closed loop and its datagrams cost on this machine.

The reference of the loop is `mj_step` in C (`mujoco.rollout`, one thread). It replays the thrusts
and the drag of the same flight and must end in a bit-identical state. The reference of a datagram
is the paper's pickled ROS message. The command measures the parts in turns; the fastest time of
each part counts.
"""

from __future__ import annotations

import argparse
import gc
import subprocess
import time
import timeit
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

from cloudrc.cli.extras import require
from cloudrc.cli.output import format_document, output_argument, table
from cloudrc.cli.parser import read_count
from cloudrc.drivers.machine import interpreter
from cloudrc.errors import CloudrcError

if TYPE_CHECKING:
    from cloudrc.cloud.endpoint import CloudEndpoint
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.virtual import VirtualRun
    from cloudrc.records import Record
    from cloudrc.world.endpoint import WorldEndpoint


CALLS = 400
"""Number of calls that are timed together."""
REFERENCE_CALLS = 40
"""Number of calls of the reference that are timed together. These calls and `CALLS` both take about
1 ms, so a busy machine rarely interrupts them."""
ROUNDS = 60
"""Number of timings of each part."""

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
"""Program that pickles messages as the paper's tunnel does.

It runs in a separate process, because cloudrc itself must not import pickle. Its classes are those
that ROS 1 generates; its Odometry has the usual size (1 kB). It unpickles only the constants that
it has just pickled.
"""


class WireCost(NamedTuple):
    """Processor time of one odometry message, sum of both ends.

    Attributes:
        sealed: Encode, seal, open and decode [s].
        unsealed: Encode and decode without the seal, as in virtual time [s].
        pickled: Pickle and unpickle, as in the paper [s].
        size: Size of the datagram [bytes].
        pickled_size: Size of the pickled message [bytes].
    """

    sealed: float
    unsealed: float
    pickled: float
    size: int
    pickled_size: int

    @property
    def ratio(self) -> float:
        """Return the ratio of sealed to pickled [1]."""
        return self.sealed / self.pickled


def measure_wire(rounds: int = ROUNDS) -> WireCost:
    """Measure the three times of a `WireCost` in turns; the fastest round of each counts."""
    from cloudrc.messages import GuardState, Odometry, Telemetry
    from cloudrc.tunnel import codec
    from cloudrc.tunnel.codec import Kind
    from cloudrc.tunnel.session import Session, pair

    odometry = Odometry(1, (0.1, 0.2, 0.3), (0.9, 0.1, 0.2, 0.3), (0.4, 0.5, 0.6), (0.7, 0.8, 0.9))
    telemetry = Telemetry(1, odometry, 0.0, 2, 3, 0, 1, GuardState.TRACK)
    kind = int(Kind.TELEMETRY)

    def cost(ends: tuple[Session, Session]) -> float:
        seal, unseal = ends[0].seal, ends[1].open
        encode, decode = codec.encode_telemetry, codec.decode_telemetry

        def send_and_receive() -> None:
            decode(unseal(seal(kind, encode(telemetry)))[-1])

        return timeit.timeit(send_and_receive, number=CALLS) / CALLS

    costs = []
    command = interpreter("-c", REFERENCE, str(REFERENCE_CALLS))
    with subprocess.Popen(command, stdin=-1, stdout=-1, text=True) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        for _ in range(rounds):
            child.stdin.write("\n")
            child.stdin.flush()
            size, pickled = child.stdout.readline().split()
            costs.append((cost(pair()), cost(pair(secret=None)), float(pickled)))
        child.stdin.close()
    fastest = [min(column) for column in zip(*costs, strict=True)]
    return WireCost(fastest[0], fastest[1], fastest[2], codec.SIZES[kind], int(size))


EPILOG = """\
'raw mj_step' replays the thrusts and the drag of the same flight in C and must
end in the same bits. Close other programs before you compare two machines; the
ratios of one run are comparable between machines."""
STEP = 0.002
"""Step of the physics [s]."""
LIMIT_NS = 120_000_000_000
"""Time limit of a flight [ns]."""
CLOCK = bytes(16)

Play = Callable[[], int]
"""Function that does the work of a part and returns its number of physics steps."""
Keep = Callable[["list[Record]"], object]
"""Function that stores records."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    output_argument(parser)
    parser.add_argument(
        "--repeats",
        type=read_count,
        default=7,
        metavar="N",
        help="how often to measure each part (default: 7)",
    )


def execute(options: argparse.Namespace) -> int:
    """Measure and print."""
    require("the bench", ("world",))
    from cloudrc.config.load import load_experiment

    costs = measure(load_experiment("paper"), options.repeats)
    raw = costs["raw mj_step"]
    figures = {
        name: {"us_per_step": cost * 1e6, "ratio": raw / cost, "real_time_factor": STEP / cost}
        for name, cost in costs.items()
    }
    wire = measure_wire()
    if options.output != "table":
        document = {**figures, "wire": {**wire._asdict(), "ratio": wire.ratio}}
        print(format_document({"schemaVersion": 1, **document}, options.output))
        return 0
    rows = [("experiment paper, mode virtual", "us a step", "ratio to raw", "x real time")]
    for name, figure in figures.items():
        cost, ratio, factor = figure.values()
        rows.append((name, f"{cost:.2f}", f"{ratio:.3f}", f"{factor:.0f}"))
    print(table(rows, right=(1, 2, 3)))
    print("\nraw replayed the same controls and ended in the same bits")
    print(
        f"\none odometry, both ends: encode, seal, open and decode {wire.sealed * 1e6:.2f} us"
        f" ({wire.size} bytes), without the seal {wire.unsealed * 1e6:.2f} us;\n"
        f"pickled as in the paper {wire.pickled * 1e6:.1f} us ({wire.pickled_size} bytes),"
        f" ratio {wire.ratio:.3f}"
    )
    return 0


def measure(experiment: ResolvedExperiment, repeats: int) -> dict[str, float]:
    """Measure flights and the replay in turns.

    Returns:
        Processor time per physics step [s], by part.
    """
    from cloudrc.record.hash import RecordHash

    replay = _replay(experiment)
    parts: dict[str, Callable[[], Play]] = {
        "raw mj_step": lambda: replay,
        "closed loop, records in memory": lambda: _flight(experiment, _memory()),
        "closed loop, records hashed": lambda: _flight(experiment, RecordHash().update),
    }
    costs = dict.fromkeys(parts, float("inf"))
    for _ in range(repeats):
        for name, prepare in parts.items():
            costs[name] = min(costs[name], _cost(prepare()))
    return costs


def _memory() -> Keep:
    records: list[Record] = []
    return records.extend


def _cost(play: Play) -> float:
    gc.collect()
    start = time.process_time()
    steps = play()
    return (time.process_time() - start) / steps


def _replay(experiment: ResolvedExperiment) -> Play:
    """Fly once, record the controls, and return the function that replays them."""
    import numpy as np

    from cloudrc.world.simulator import replay

    world, cloud, run = _assemble(experiment)
    simulator = world.robot.simulator
    start, simulator.tape = simulator.state(), []
    run.fly(lambda: cloud.mission_over, LIMIT_NS, lambda of_world, of_cloud: None)
    tape, end = np.array(simulator.tape), simulator.state().physics

    def play() -> int:
        if (replay(simulator.model, start, tape) != end).any():
            raise CloudrcError("the replay does not end in the state of the flight; report this")
        return len(tape)

    return play


def _flight(experiment: ResolvedExperiment, keep: Keep) -> Play:
    """Prepare a flight whose records go to `keep`."""
    _, cloud, run = _assemble(experiment)

    def sink(of_world: list[Record], of_cloud: list[Record]) -> None:
        keep(of_world)
        keep(of_cloud)

    def play() -> int:
        run.fly(lambda: cloud.mission_over, LIMIT_NS, sink)
        return round(run.now_ns * 1e-9 / STEP)

    return play


def _assemble(
    experiment: ResolvedExperiment,
) -> tuple[WorldEndpoint, CloudEndpoint, VirtualRun]:
    from cloudrc import assembly
    from cloudrc.cloud.endpoint import CloudIdentity
    from cloudrc.drivers.virtual import VirtualRun
    from cloudrc.world.endpoint import WorldIdentity

    world = assembly.build_world(experiment, WorldIdentity(CLOCK, b"world".ljust(16)))
    cloud = assembly.build_cloud(experiment, CloudIdentity(CLOCK, b"cloud".ljust(16)))
    return world, cloud, VirtualRun(world, cloud, *assembly.build_links(experiment))
