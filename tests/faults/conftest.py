"""A robot for the watch to look at, which does whatever a test has it do."""

from types import SimpleNamespace

from cloudrc.faults.invariants import FLOWN, Watch
from cloudrc.messages import ZERO, Cause, Command, GuardState
from cloudrc.world.rotors import STOPPED

MS = 1_000_000
INSIDE = (1.0, 1.0, 1.0)
TRACK = GuardState.TRACK


class World:
    """A robot that is wherever a test puts it."""

    def __init__(self, yaw_rate=0.0, refusal=None, honest=False, hold_max_ms=60_000):
        self.readings = SimpleNamespace(position=INSIDE, velocity=ZERO)
        self.refusal, self.steps = refusal, 0
        self.watch = Watch(6.0, 12.0, 1.0, 250 * MS, hold_max_ms * MS)
        self.simulator = SimpleNamespace(readings=self.readings, step=self._step)
        self.simulator._steps, self.simulator._last_touch = 0, {}
        self.guard = SimpleNamespace(state=TRACK, reference=ZERO, yaw_rate=yaw_rate)
        self.guard.cause = Cause.ENDED
        self.guard.offer = lambda command, now: self.refusal
        for word in ("stop", "acknowledge", "tick", "start_mission", "end_mission"):
            setattr(self.guard, word, lambda now: None)
        self.guard.put_on_ground = lambda now, cause: None
        self.guard.forget_commands = lambda: None
        self.robot = SimpleNamespace(simulator=self.simulator, guard=self.guard)
        self.watch.attach(self, 0, honest=honest)
        self.guard.start_mission(0)
        self.offer(1)

    def offer(self, count):
        for _ in range(count):
            self.guard.offer(Command(0, 0, 0, ZERO, 0.0), 0)

    def say_what_is_impossible(self):
        """Five times, which has a robot land."""
        refusal, self.refusal = self.refusal, "range"
        self.offer(5)
        self.refusal = refusal

    def _step(self, rotor_speeds):
        self.steps += 1
        self.simulator._steps += 1

    def tick(
        self, *references, state=TRACK, position=INSIDE, turns=None, released=True, ruled=True
    ):
        """Fly references, one a tick, and say what kinds of breach there were."""
        for reference in references:
            if released:
                self.guard.acknowledge(0)
                self.offer(10)
            if state is GuardState.LAND:
                self.say_what_is_impossible()
            self.guard.state, self.guard.reference = state, reference
            if released:
                self.guard.start_mission(0)
            self.readings.position = position
            turns = state in FLOWN if turns is None else turns
            if ruled:
                self.guard.tick(self.steps * 2 * MS)
            self.simulator.step((900.0,) * 4 if turns else STOPPED)
        return set(self.watch.counts)
