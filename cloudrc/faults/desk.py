"""The operator's desk in virtual time: teleop's service with its journal, which may die and return.

Cloud's end is joined to it as it is to the process of teleop: while that is away, nobody answers.
It sees and says everything at once, as long as cloud asks it to; see `Apart` for one that does not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from cloudrc.cloud.operator import Operator
from cloudrc.faults.mortal import Mortal
from cloudrc.records import Fault, MissionEvent
from cloudrc.teleop.bridge import Call
from cloudrc.teleop.journal import Entry, Journal
from cloudrc.teleop.service import MissionService
from cloudrc.teleop.store import ConflictError, Mission, Order, UnavailableError
from cloudrc.teleop.wire import Outcome, Output, Plan, Seen

Keep = Callable[[Entry], None]


class Desk:
    """What cloud's end has for an operator.

    Attributes:
        service: The one that lives now; None while teleop is down.
        entries: What the journal holds.
        repairs: What was wrong with it whenever it was opened.
        events: All that has happened to missions, oldest first.
        refuse: If set, it is called before an entry is kept; a full disk raises OSError.
    """

    outcome: Outcome | None = None
    settled = True

    def __init__(
        self, contact_speed_max: float, path: Path | None = None, name: bytes = b"desk"
    ) -> None:
        """Open for the first time.

        Args:
            contact_speed_max: Below which the arm's tip may meet the board [m/s].
            name: Tells its missions from those of another desk.
            path: Of a real journal; None for one in memory that never fails.
        """
        self._contact_speed_max, self._path, self._name = contact_speed_max, path, name
        self._journal: Journal | None = None
        self._started = 0
        self.repairs: list[str] = []
        self.entries: list[Entry] = []
        self.events: list[MissionEvent] = []
        self.refuse: Callable[[], None] | None = None
        self.service: MissionService | None = None
        self._outputs: list[Output | Fault] = []
        self.start()

    def start(self) -> None:
        """A new process, which has nothing but the journal."""
        if self._path is not None:
            self._journal = Journal(self._path)
            self.entries = list(self._journal.entries)
            self.repairs.append(self._journal.trouble)
        entries, self._started = list(self.entries), self._started + 1
        salt = b"%s %d" % (self._name, self._started)  # in production it is random
        self.service = MissionService(self._contact_speed_max, self._keep, entries, salt=salt)

    def kill(self) -> None:
        """Teleop is gone, and what it had not written down with it."""
        if self._journal is not None:
            self._journal.close()
        self.service = self._journal = None
        self._outputs.clear()

    def order(self, plan: Plan, now_ns: int, **options: Any) -> Mission:
        """Post a mission; it is started at once."""
        assert self.service is not None, "teleop is down"
        mission, _ = self.service.create(Order(plan, **options), now_ns)
        return mission

    def ask(self, call: Call, now_ns: int) -> None:
        """Have a call of the API made on cloud's clock [ns]; what it refuses is dropped."""
        if self.service is not None:
            with suppress(ConflictError, UnavailableError):
                call(self.service, now_ns)

    def stop_rotors(self, now_ns: int) -> None:
        """An emergency stop by the API at an instant [ns] of cloud's clock."""
        self.ask(MissionService.stop_rotors, now_ns)

    def shut_down(self, now_ns: int) -> None:
        """SIGTERM at an instant [ns] of cloud's clock."""
        if self.service is not None:
            self.service.pause(now_ns)

    def live(self, host: Mortal) -> None:
        """Time begins on the machine of cloud, which is teleop's, too."""

    def join(self, start_ns: int) -> Operator:
        """Give a new cloud, born at an instant [ns] of its clock, what it has for teleop."""
        return self

    @property
    def missions(self) -> list[Mission]:
        """All that the service knows, oldest first; none while it is down."""
        return list(self.service.book.missions.values()) if self.service is not None else []

    @property
    def last(self) -> Mission:
        """The mission ordered last."""
        return self.missions[-1]

    # What cloud's end knows of it.

    @property
    def outputs(self) -> Sequence[Output | Fault]:
        """See `cloudrc.cloud.operator.Operator`."""
        return self._outputs

    def hear(self, now_ns: int) -> None:
        """Take note that cloud lives."""
        if self.service is not None:
            self.service.hear(now_ns)

    def see(self, seen: Seen, now_ns: int) -> None:
        """See `cloudrc.cloud.operator.Operator`."""
        if self.service is not None:
            self.service.see(seen, now_ns)
            self._collect()

    def handle_deadline(self, now_ns: int) -> None:
        """See `cloudrc.cloud.operator.Operator`."""
        if self.service is not None:
            self.service.handle_deadline(now_ns)
            self._collect()

    def take_outputs(self) -> Sequence[Output | Fault]:
        """See `cloudrc.cloud.operator.Operator`."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def _collect(self) -> None:
        assert self.service is not None
        outputs = self.service.take_outputs()
        self.events += [said for said in outputs if isinstance(said, MissionEvent)]
        self._outputs += outputs

    def _keep(self, entry: Entry) -> None:
        if self.refuse is not None:
            self.refuse()
        if self._journal is not None:
            self._journal.append(entry)
        self.entries.append(entry)
