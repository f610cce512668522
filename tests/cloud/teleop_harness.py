"""A robot and a lossy link for teleop to talk to: no world, no tunnel, no clock."""

from cloudrc.messages import Cause, GuardState, OperatorRequest, Request, Setpoint, Start
from cloudrc.records import MissionEvent
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.wire import Leg, Plan, Seen, StartMission

PERIOD_NS = 10_000_000
A, B, C = (1.0, 0.0, 1.0), (2.0, 0.0, 1.0), (3.0, 0.0, 1.0)
AWAY = (0.0, -5.0, 1.0)
ID = 7
THREE = Plan((Leg(A, dwell=0.0), Leg(B, dwell=0.0), Leg(C, dwell=0.0)), Start.HERE)
FROM_SPAWN = Plan(THREE.legs)
PLAN = Plan((Leg(A, yaw=0.3), Leg(B, tolerance=0.2, dwell=0.0), Leg(C)))


class Flight:
    """Teleop, the robot that it steers, and everything that it has said."""

    def __init__(self):
        self.teleop = Teleop()
        self.now_ns = 0
        self.position = (0.0, 0.0, 0.1)
        self.epoch = 1
        self.world = "world 1"
        self.mission = 0
        self.onboard = (0, 0)  # mission's number and waypoints reached, as world keeps them
        self.guard, self.cause = GuardState.GROUND, Cause.SPAWN
        self.uplink = self.downlink = True
        self.first_shown_ns = {}  # number of a request -> when telemetry first showed it
        self.said = []
        self.said_at = []

    def step(self, position=None, seconds=0.01):
        """Let time pass in periods of 10 ms, telemetry and deadline in each."""
        self.position = self.position if position is None else position
        for _ in range(round(seconds * 100)):
            self.now_ns += PERIOD_NS
            if self.uplink:
                self.see()
            self.teleop.handle_deadline(self.now_ns)
            self._collect()

    def see(self):
        seen = Seen(
            self.epoch, self.position, self.guard, self.mission, self.world, **self.progress()
        )
        self.first_shown_ns.setdefault(self.mission, self.now_ns)
        self.teleop.see(seen, self.now_ns)

    def progress(self):
        told = (*self.onboard, self.cause)
        return dict(zip(("mission_id", "reached", "cause"), told, strict=True))

    def operate(self, verb):
        try:
            self.teleop.operate(verb, self.now_ns)
        finally:
            self._collect()

    def restart(self):
        """World loses everything it knew."""
        self.world = f"world {self.epoch + 1}"
        self.epoch += 1
        self.mission = 0
        self.onboard = (0, 0)
        self.guard = GuardState.GROUND
        self.position = (0.0, 0.0, 0.1)

    def restart_cloud(self):
        """A new cloud opens a new epoch in the same world, and counts requests from 1 again."""
        self.epoch += 1
        self.mission = 0
        self.guard = GuardState.HOLD

    @property
    def state(self):
        return self.teleop.state.name

    @property
    def requests(self):
        return [said for said in self.said if isinstance(said, OperatorRequest)]

    @property
    def events(self):
        return [said for said in self.said if isinstance(said, MissionEvent)]

    @property
    def setpoints(self):
        return [said for said in self.said if isinstance(said, Setpoint)]

    def _collect(self):
        for output in self.teleop.take_outputs():
            for_session = isinstance(output, Setpoint | OperatorRequest)
            said = output._replace(epoch=0) if for_session else output
            self.said.append(said)
            self.said_at.append(self.now_ns)
            if isinstance(said, OperatorRequest) and self.downlink:
                self._obey(said)

    def _obey(self, request):
        """Act on it as world does: rising numbers only; a start from the spawn restarts."""
        if request.request is Request.PROGRESS:
            self._keep(request)
        if request.number <= self.mission:
            return
        self.mission = request.number
        if request.request is not Request.START:
            stopped = self.guard in (GuardState.LAND, GuardState.ESTOP)
            if request.request is Request.ESTOP:
                self.guard, self.cause = GuardState.ESTOP, Cause.STOPPED
            elif request.request is Request.ACKNOWLEDGE:
                self.guard = GuardState.GROUND if stopped else self.guard
            elif not stopped:
                self.guard = GuardState.HOLD
            return
        if request.mission_id != self.onboard[0] or request.start is Start.SPAWN:
            self.onboard = (request.mission_id, 0)
        self._keep(request)
        if request.start is Start.SPAWN:
            self.epoch += 1
            self.position = (0.0, 0.0, 0.1)
        if self.guard not in (GuardState.LAND, GuardState.ESTOP):
            self.guard, self.cause = GuardState.TRACK, Cause.COMMAND

    def _keep(self, request):
        number, reached = self.onboard
        if request.mission_id == number:
            self.onboard = (number, max(reached, request.reached))


def flying(plan=PLAN):
    """A flight whose mission has just started."""
    flight = Flight()
    flight.step()
    flight.operate(StartMission(plan))
    flight.step(seconds=0.03)
    assert flight.state == "FLYING"
    return flight
