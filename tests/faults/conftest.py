"""A robot for the invariants to watch, which does whatever a test has it do."""

from functools import cache
from types import SimpleNamespace

from cloudrc.config.load import load_experiment
from cloudrc.faults.invariants import Steps
from cloudrc.faults.observer import RobotObserver
from cloudrc.faults.rules import FLOWN, TRACK, Rules
from cloudrc.messages import ZERO, Command, OperatorRequest, Request, Start
from cloudrc.records import Contact
from cloudrc.robots.pelican.rotors import STOPPED

MS = 1_000_000
TURNING = (900.0,) * 4


@cache
def experiment(robot="pelican"):
    """Return the experiment of a robot."""
    name = "pillars" if robot == "rover" else "paper"
    return load_experiment(name, ["link.profile=ideal", "guard.plan_max_s=0.8"])


class FakeRobot:
    """A robot in a mission; it is in whatever state and place a test puts it."""

    def __init__(self, *, yaw_rate=0.0, robot="pelican"):
        self.guard = SimpleNamespace(state=TRACK, reference=ZERO, yaw_rate=yaw_rate)
        self.simulator = SimpleNamespace(steps=0, touch_age=float("inf"), touches=[])
        self.onboard = SimpleNamespace(stopped=STOPPED)
        self.observers = []
        self.position, self.velocity = (1.0, 1.0, 1.0), ZERO
        self.now_ns = 0
        self.observer = RobotObserver(self, Rules(experiment(robot)), 0)
        self.request(Request.START)

    def broken(self):
        """Return the kinds of breaches."""
        found = *self.observer.breaches, *Steps(self.observer).breaches()
        return {breach.kind for breach in found}

    def request(self, *requests):
        """Carry out operator requests; the guard's state stays what a test says."""
        for request in requests:
            self.observer.see_request(OperatorRequest(1, request, Start.HERE), self.now_ns)

    def offer(self, count=1, rejection=None, basis_ms=None, plan=0):
        """Let commands come now; without `basis_ms` they are fresh. `plan` is its length."""
        basis_ns = self.now_ns if basis_ms is None else round(basis_ms * MS)
        for _ in range(count):
            command = Command(0, basis_ns, 0, ZERO, 0.0, (ZERO,) * plan, basis_ns)
            self.observer.see_command(command, rejection, self.now_ns)

    def touch(self, body, *, by_probe=False):
        """Let a contact begin in the next step."""
        self.simulator.touches.append(Contact(0, body, self.position, ZERO, ZERO, by_probe))

    def put(self, velocity=ZERO, touch_age=float("inf")):
        """Let the robot move [m/s], and have touched something some time ago [s]."""
        self.velocity, self.simulator.touch_age = velocity, touch_age

    def skip(self, ms):
        """Let time pass without a step [ms]."""
        self.now_ns += round(ms * MS)

    def step(self, state, *, ms=2, reference=None, position=None, turns=None, fresh=True):
        """Be in a state for some time.

        `turns` says whether the rotors turn (by default in flight), `fresh` whether a fresh command
        comes before each step in TRACK.
        """
        self.guard.state = state
        self.guard.reference = reference or self.guard.reference
        self.position = position or self.position
        speeds = TURNING if (state in FLOWN if turns is None else turns) else STOPPED
        for _ in range(ms // 2):
            if state is TRACK and fresh:
                self.offer()
            self.simulator.steps += 1
            readings = SimpleNamespace(position=self.position, velocity=self.velocity)
            self.observer.see_step(self.now_ns, readings, speeds)
            self.now_ns += 2 * MS
