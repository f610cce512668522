"""A robot, a lossy link and a journal in memory for the mission service to fly with."""

import json

from teleop_harness import A, B, C, Flight

from cloudrc.records import Fault
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import Order
from cloudrc.teleop.wire import Leg, Plan, Seen

PLAN = Plan((Leg(A, dwell=0.0), Leg(B, dwell=0.0), Leg(C, dwell=0.0)))


class ServiceFlight(Flight):
    """The harness of the machine, with a service in its place that may be restarted."""

    def __init__(self):
        super().__init__()
        self.kept = []
        self.full, self.tries = False, 0
        self.pipe_contacts, self.touch_speed, self.slip_ns = 0, float("nan"), 0
        self.restart_teleop()

    def restart_teleop(self):
        """A new process, that has nothing but the journal."""
        self.teleop = MissionService(0.25, self.write, json.loads(json.dumps(self.kept)), salt=b"")

    def write(self, entry):
        self.tries += 1
        if self.full:
            raise OSError(28, "No space left on device")
        self.kept.append(json.loads(json.dumps(entry)))

    def see(self):
        self.teleop.see(self.seen, self.now_ns)

    @property
    def seen(self):
        return Seen(
            self.epoch,
            self.position,
            self.guard,
            self.mission,
            self.world,
            self.pipe_contacts,
            self.touch_speed,
            self.slip_ns,
            **self.progress(),
        )

    def create(self, plan=PLAN, **order):
        mission, _ = self.teleop.create(Order(plan, **order), self.now_ns)
        self._collect()
        return mission.id

    def view(self, mission_id):
        return self.teleop.book.find(mission_id).as_json()

    def names(self, mission_id):
        return [event["event"] for event in self.view(mission_id)["events"]]

    @property
    def faults(self):
        return [said for said in self.said if isinstance(said, Fault)]


def flying(**order):
    """A flight on its way to the second waypoint."""
    flight = ServiceFlight()
    flight.step()
    mission_id = flight.create(**order)
    flight.step(seconds=0.05)
    flight.step(position=A)
    assert flight.view(mission_id)["state"] == "flying"
    assert flight.view(mission_id)["waypoint"] == 1
    return flight, mission_id
