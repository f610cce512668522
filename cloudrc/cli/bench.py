"""`cloudrc bench`: measure what the closed loop and its datagrams cost on this machine.

The reference of the loop is `mj_step` in C (`mujoco.rollout`, one thread), the reference of a
datagram is the paper's pickled ROS message. The parts are measured in turns; the fastest time of
each part counts.
"""

from __future__ import annotations

import argparse
import gc
import subprocess
import time
import timeit
from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.cli.extras import require
from cloudrc.cli.output import format_document, output_argument, table
from cloudrc.cli.parser import read_count
from cloudrc.drivers.machine import interpreter
from cloudrc.errors import CloudrcError

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.records import Record

CALLS, REFERENCE_CALLS = 400, 40
"""Numbers of calls that are timed together, of ours and of the reference. Both take about 1 ms, so
a busy machine rarely interrupts them."""
ROUNDS = 60
"""Number of timings of each part."""
STEP = 0.002
"""Step of the physics [s]."""
LIMIT_NS = 120_000_000_000
"""Time limit of a flight [ns]."""
EPILOG = """\
'raw mj_step' replays the thrusts and the drag of the same flight in C and must
end in the same bits. Close other programs before you compare two machines; the
ratios of one run are comparable between machines."""
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
for name, count in dict(
    Time=2, Header=3, Point=3, Quaternion=4, Pose=2, Vector3=3, Twist=2,
    PoseWithCovariance=2, TwistWithCovariance=2, Odometry=4,
).items():
    members = {"__slots__": tuple("abcd"[:count]), "__module__": "__main__"}
    globals()[name] = type(name, (Message,), members)
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
"""Program that pickles messages as the paper's tunnel does, in a separate process, because cloudrc
itself must not import pickle. Its classes are those that ROS 1 generates; its Odometry has the
usual size (1 kB)."""


def measure_wire() -> dict[str, float]:
    """Measure the processor time [s] of one odometry message at both ends, and its size [bytes].

    `unsealed` is without the seal, as in virtual time; `ratio` is `sealed` divided by `pickled`.
    """
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
        for _ in range(ROUNDS):
            child.stdin.write("\n")
            child.stdin.flush()
            size, reference = child.stdout.readline().split()
            costs.append((cost(pair()), cost(pair(secret=None)), float(reference)))
        child.stdin.close()
    sealed, plain, pickled = (min(column) for column in zip(*costs, strict=True))
    sizes = {"size": codec.SIZES[kind], "pickled_size": int(size), "ratio": sealed / pickled}
    return {"sealed": sealed, "unsealed": plain, "pickled": pickled, **sizes}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    output_argument(parser)
    about = "how often to measure each part (default: 7)"
    parser.add_argument("--repeats", type=read_count, default=7, metavar="N", help=about)


def execute(options: argparse.Namespace) -> int:
    """Measure and print."""
    require("the bench", ("world",))
    from cloudrc.config.load import load_experiment

    costs = _measure(load_experiment("paper"), options.repeats)
    raw = costs["raw mj_step"]
    wire = measure_wire()
    if options.output != "table":
        figures = {
            name: {"us_per_step": cost * 1e6, "ratio": raw / cost, "real_time_factor": STEP / cost}
            for name, cost in costs.items()
        }
        document = {"schemaVersion": 1, **figures, "wire": wire}
        print(format_document(document, options.output))
        return 0
    rows = [("experiment paper, mode virtual", "us a step", "ratio to raw", "x real time")]
    for name, cost in costs.items():
        rows.append((name, f"{cost * 1e6:.2f}", f"{raw / cost:.3f}", f"{STEP / cost:.0f}"))
    print(table(rows, right=(1, 2, 3)))
    print(
        "\nraw replayed the same controls and ended in the same bits\n"
        f"\none odometry, both ends: encode, seal, open and decode {wire['sealed'] * 1e6:.2f} us"
        f" ({wire['size']} bytes), without the seal {wire['unsealed'] * 1e6:.2f} us;\n"
        f"pickled as in the paper {wire['pickled'] * 1e6:.1f} us ({wire['pickled_size']} bytes),"
        f" ratio {wire['ratio']:.3f}"
    )
    return 0


def _measure(experiment: ResolvedExperiment, repeats: int) -> dict[str, float]:
    """Measure flights and the replay in turns: processor time per physics step [s], by part."""
    from cloudrc.record.hash import RecordHash

    replay = _replay(experiment)
    parts: dict[str, Callable[[], float]] = {
        "raw mj_step": lambda: _cost(replay),
        "closed loop, records in memory": lambda: _flight_cost(experiment, list[object]().extend),
        "closed loop, records hashed": lambda: _flight_cost(experiment, RecordHash().update),
    }
    costs = dict.fromkeys(parts, float("inf"))
    for _ in range(repeats):
        for name, cost in parts.items():
            costs[name] = min(costs[name], cost())
    return costs


def _cost(play: Callable[[], int]) -> float:
    """Measure the processor time per step [s] of a function that returns its number of steps."""
    gc.collect()
    start = time.process_time()
    steps = play()
    return (time.process_time() - start) / steps


def _replay(experiment: ResolvedExperiment) -> Callable[[], int]:
    """Fly once, record the controls, and return the function that replays them."""
    import numpy as np

    from cloudrc.cli.run import assemble
    from cloudrc.world.simulator import replay

    world, cloud, run = assemble(experiment)
    simulator = world.robot.simulator
    start, simulator.tape = simulator.state(), []
    run.fly(lambda: cloud.mission_over, LIMIT_NS, lambda of_world, of_cloud: None)
    tape, end = np.array(simulator.tape), simulator.state()[0]

    def play() -> int:
        if (replay(simulator.model, *start, tape) != end).any():
            raise CloudrcError("the replay does not end in the state of the flight; report this")
        return len(tape)

    return play


def _flight_cost(experiment: ResolvedExperiment, keep: Callable[[list[Record]], object]) -> float:
    """Measure a flight whose records go to `keep`."""
    from cloudrc.cli.run import assemble

    _, cloud, run = assemble(experiment)

    def sink(of_world: list[Record], of_cloud: list[Record]) -> None:
        keep(of_world)
        keep(of_cloud)

    def play() -> int:
        run.fly(lambda: cloud.mission_over, LIMIT_NS, sink)
        return round(run.now_ns * 1e-9 / STEP)

    return _cost(play)
