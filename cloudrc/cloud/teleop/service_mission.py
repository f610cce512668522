"""One mission as teleop remembers it: journal entries come in; what the API shows goes out."""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from dataclasses import asdict, dataclass, field
from typing import Any

from cloudrc.cloud.teleop.journal_format import Entry
from cloudrc.cloud.teleop.messages import Continue, Outcome, StartMission
from cloudrc.cloud.teleop.plan import Leg, Plan
from cloudrc.cloud.teleop.verdict import Criteria, Failure, Verdict, Witness, judge
from cloudrc.messages import Start

QUEUED, STARTING, FLYING, HELD = "queued", "starting", "flying", "held"
DONE, FAILED, CANCELLED = "done", "failed", "cancelled"
ENDED = (DONE, FAILED, CANCELLED)
SHOWN = 100
"""Events of a mission that are shown, the newest: a mission has some ten, but one that is held can
be sent elsewhere without end, and every answer has them. The journal keeps the others, too."""
NEVER_BEGAN = "mission cancelled before it began"

STATES = {
    "queued": QUEUED,
    "starting": STARTING,
    "started": FLYING,
    "resumed": FLYING,
    "held": HELD,
    "done": DONE,
    "cancelled": CANCELLED,
    "timed_out": FAILED,
    "leg_timed_out": FAILED,
    "world_restarted": FAILED,
    "guard_stopped": FAILED,
    "emergency_stopped": FAILED,
    "taken_over": FAILED,
    "end_lost": FAILED,
}
"""State of a mission after an event; one that is not named here changes nothing."""


@dataclass(frozen=True, slots=True)
class Order:
    """What somebody asks to be flown.

    Attributes:
        plan: Checked.
        name: For people.
        key: The same key never makes a second mission; "" for none.
        contact: Whether the arm has to touch the board.
        queue: Whether to wait for the mission that is under way, in place of being refused.
    """

    plan: Plan
    name: str = ""
    key: str = ""
    contact: bool = False
    queue: bool = False


@dataclass(slots=True)
class Mission:
    """Everything that is known of a mission; it follows from its journal entries alone.

    Attributes:
        id: Given by teleop.
        order: What was asked for.
        number: Names it on board, where its progress is kept, too; below 2^63, 0 if it is not.
        state: One of `STATES`.
        world: Names the world in which it was started; "" before that.
        elapsed: How long it had lasted at its last event [s].
        reached: Index of each waypoint reached and when [s].
        events: The newest of what has happened, as the API shows it.
        happened: How often each event has, the older ones counted.
        witness: What the robot has touched.
        verdict: As the API shows it; None until it has ended.
    """

    id: str
    order: Order
    number: int = 0
    state: str = QUEUED
    world: str = ""
    elapsed: float = 0.0
    reached: list[dict[str, Any]] = field(default_factory=list)
    events: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=SHOWN))
    happened: Counter[str] = field(default_factory=Counter)
    witness: Witness = field(default_factory=Witness)
    verdict: dict[str, Any] | None = None

    @property
    def ended(self) -> bool:
        """Whether it is over."""
        return self.state in ENDED

    @property
    def waypoint(self) -> int:
        """Index of the waypoint that is flown to, or was at the end."""
        return min(len(self.reached), len(self.order.plan.legs) - 1)

    def apply(self, entry: Entry) -> None:
        """Take in an entry of kind "event"."""
        event = {k: entry[k] for k in ("id", "mission", "event", "waypoint", "text", "time_s")}
        self.events.append(event)
        self.happened[entry["event"]] += 1
        self.state = STATES.get(entry["event"], self.state)
        self.elapsed, self.world = entry["time_s"], entry["world"]
        if self.world and self.state in (QUEUED, STARTING):
            self.state = FLYING  # it was started, though a damaged journal has lost what said so
        self.witness = Witness(**entry["witness"])
        self.verdict = entry.get("verdict", self.verdict)
        # A waypoint is reached once, whatever is told how often.
        if entry["event"] == "reached" and entry["waypoint"] == len(self.reached):
            self.reached.append({"waypoint": entry["waypoint"], "time_s": entry["time_s"]})

    def in_new_session(self) -> str:
        """What to say when the controller has another session with the same robot."""
        where = f"waypoint {self.waypoint + 1} of {len(self.order.plan.legs)}"
        goes_on = f"is held on the way to {where}" if self.state == HELD else f"goes on to {where}"
        return f"the controller has a new session, as after a restart; the mission {goes_on}"

    def judged(self, outcome: Outcome, contact_speed_max: float, elapsed: float) -> dict[str, Any]:
        """The verdict on how it ended, as the API shows it.

        Args:
            outcome: How that was.
            contact_speed_max: Below which the arm's tip may meet the board [m/s].
            elapsed: How long it has lasted [s].
        """
        criteria = Criteria(self.order.contact, contact_speed_max)
        count = len(self.order.plan.legs)
        return judge(outcome, self.witness, criteria, waypoints=count, elapsed=elapsed).as_json()

    def forsake(self) -> None:
        """A later mission has begun: this one is over, although nothing kept says how it ended."""
        text = "how it ended was not kept: the journal was damaged or could not be written"
        self.state = FAILED
        self.verdict = Verdict("failure", (Failure("end_lost", text),)).as_json()

    def entry(self, number: int, event: str, text: str, **changed: Any) -> Entry:
        """Make the entry of something that happens to the mission now."""
        return {
            "kind": "event",
            "id": number,
            "mission": self.id,
            "event": event,
            "text": text,
            "waypoint": self.waypoint,
            "time_s": round(self.elapsed, 3),
            "world": self.world,
            "witness": asdict(self.witness),
            **changed,
        }

    def summary(self) -> dict[str, Any]:
        """What a list of missions shows."""
        return {
            "id": self.id,
            "name": self.order.name,
            "key": self.order.key,
            "state": self.state,
            "waypoint": self.waypoint,
            "waypoints": len(self.order.plan.legs),
            "reached": list(self.reached),
            "verdict": self.verdict,
        }

    def as_json(self) -> dict[str, Any]:
        """Everything, but no more than `SHOWN` events, as the API shows it."""
        left_out = self.happened.total() - len(self.events)
        return {**self.summary(), "events": list(self.events), "events_left_out": left_out}


def order_entry(mission: Mission) -> Entry:
    """Make the entry that a mission begins with."""
    order, plan = mission.order, mission.order.plan
    return {
        "kind": "mission",
        "mission": mission.id,
        "number": mission.number,
        "name": order.name,
        "key": order.key,
        "contact": order.contact,
        "start": plan.start.name,
        "time_limit": plan.time_limit,
        "legs": [
            [list(leg.position), leg.yaw, leg.tolerance, leg.dwell, leg.time_limit]
            for leg in plan.legs
        ],
    }


def from_entry(entry: Entry) -> Mission:
    """Make the mission that an entry of kind "mission" began."""
    legs = tuple(Leg(tuple(position), *rest) for position, *rest in entry["legs"])
    plan = Plan(legs, Start[entry["start"]], entry["time_limit"])
    order = Order(plan, entry["name"], entry["key"], entry["contact"])
    return Mission(entry["mission"], order, entry["number"])


def number_of(mission_id: str, salt: bytes) -> int:
    """Name a mission in 63 bits; ids begin again with a new journal, the salt does not.

    Args:
        mission_id: Ours, such as "m1".
        salt: Bytes that no other journal had.
    """
    digest = hashlib.sha256(salt + mission_id.encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1 or 1


def never_began() -> dict[str, Any]:
    """The verdict on a mission that was cancelled before it began, as the API shows it."""
    return Verdict("interrupted", (Failure("cancelled", NEVER_BEGAN),)).as_json()


def first_verb(mission: Mission) -> StartMission | Continue:
    """How to begin: anew, or where a teleop before this one left off."""
    plan, number = mission.order.plan, mission.number
    if not mission.world:
        return StartMission(plan, number, again=True)
    held = mission.state == HELD
    return Continue(plan, mission.waypoint, mission.elapsed, mission.world, held, number)
