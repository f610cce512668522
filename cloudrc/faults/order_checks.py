"""Check commands, requests and the guard's states: invariants stale, latch and hold."""

from __future__ import annotations

from collections import deque
from math import inf

from cloudrc.faults.watch import ESTOP, GROUND, HOLD, LAND, LATCHED, TRACK, Watch
from cloudrc.messages import PLAN_STEP_NS, Command, GuardState, OperatorRequest, Request, Start
from cloudrc.world.robot import STEP_NS

RESUME_COMMANDS, RESUME_NS = 10, 500_000_000
"""Number of fresh commands that end a HOLD, and the time within which they must arrive [ns]."""
SETTLE_NS = 1_000_000_000  # shortest time between two changes to TRACK [ns]
INVALID_COMMANDS, INVALID_NS = 5, 1_000_000_000
"""Number of impossible commands that cause a landing, if they arrive within INVALID_NS [ns]."""
INVALID = ("range", "vertical", "future")  # why the guard rejects impossible commands
GROUND_NS = 10_000_000_000
"""Shortest time that a robot on the ground waits for a mission's first command [ns]."""
RAMP_MIN = 1.0
"""Shortest time of slow growth of the velocity reference after a HOLD [s]."""


class OrderChecks:
    """Checks each change of the guard's state, from the commands and requests that came before."""

    def __init__(self, watch: Watch) -> None:
        self._watch, self._note, limits = watch, watch.note, watch.limits
        self._age_ns = round(limits.command_age_max_ms * 1e6)
        self._plan_ns = round(limits.plan_max_s * 1e9)
        self._hold_ns = round(limits.hold_max_s * 1e9)
        self._ramp_ns = round(max(RAMP_MIN, limits.speed_max_mps / watch.braking) * 1e9)
        self._fresh_until_ns = -1  # when the last accepted command gets too old [ns]
        self._ramp_until_ns, self._alone_ns = -1, 0
        self._tracked_ns = -SETTLE_NS
        self._armed = False  # whether a mission is on
        self._released = set[GuardState]()  # states acknowledged since the last change
        self._is_reset = self._impossible = False
        self._fresh_ns: deque[int] = deque(maxlen=RESUME_COMMANDS)
        self._invalid_ns: deque[int] = deque(maxlen=INVALID_COMMANDS)

    @property
    def is_ramped(self) -> bool:
        """Whether a HOLD has ended so recently that the reference must grow slowly."""
        return self._watch.now_ns < self._ramp_until_ns

    def forget_commands(self) -> None:
        """Forget the commands of the old session."""
        self._fresh_until_ns = -1
        self._fresh_ns.clear()
        self._invalid_ns.clear()

    def see_command(self, command: Command, rejection: str | None, state: GuardState) -> None:
        """Check the age of an accepted command, and count invalid ones."""
        now_ns = self._watch.now_ns
        if rejection is None:
            self._accept(command, state, now_ns)
        elif rejection in INVALID:
            self._invalid_ns.append(now_ns)
            took_ns = now_ns - self._invalid_ns[0]
            if len(self._invalid_ns) == INVALID_COMMANDS and took_ns <= INVALID_NS:
                self._impossible = True

    def _accept(self, command: Command, state: GuardState, now_ns: int) -> None:
        basis_ns = command.basis_stamp_ns
        age_ns = now_ns - basis_ns
        if not 0 <= age_ns <= self._age_ns:
            self._note("stale", f"accepted a command {age_ns * 1e-9:.3f} s old")
        self._fresh_until_ns = basis_ns + self._age_ns
        if command.plan:
            end_ns = command.planned_ns + (len(command.plan) + 1) * PLAN_STEP_NS
            end_ns = min(end_ns, now_ns + self._plan_ns)
            self._fresh_until_ns = max(self._fresh_until_ns, end_ns)
        if self._armed and state is HOLD:
            self._fresh_ns.append(now_ns)
        elif self._armed and state is GROUND:
            self._alone_ns = now_ns

    def see_request(self, request: OperatorRequest, state: GuardState) -> None:
        """Store what a request allows the robot to do; `state` is that before the request."""
        match request.request:
            case Request.START:
                is_reset = request.start is Start.SPAWN
                if is_reset:
                    self._tracked_ns = -SETTLE_NS
                    self._is_reset, self._ramp_until_ns = True, -1
                if is_reset or not self._armed:
                    self.forget_commands()
                    self._alone_ns = self._watch.now_ns
                self._armed = True
            case Request.ESTOP | Request.END:
                self._armed = False
            case Request.ACKNOWLEDGE:
                self._released.add(state)

    def check_change(self, was: GuardState, state: GuardState) -> None:
        """Check a change of the guard's state from `was` to `state`."""
        if was in LATCHED and self._released.isdisjoint(LATCHED) and state is not ESTOP:
            self._note("latch", f"{was.name} left for {state.name} without the operator")
        self._released.intersection_update({state})
        self._armed = self._armed and state not in LATCHED
        self._ramp_until_ns = -1
        if state is TRACK:
            self._enter_track(was, self._watch.now_ns)
        elif state is HOLD or (was is TRACK and state is GROUND and not self._is_reset):
            # To GROUND: the robot had not left the ground yet.
            self._alone_ns = self._watch.now_ns
        elif state is LAND and not self._impossible:
            alone_ns = self._watch.now_ns - self._alone_ns
            if alone_ns <= self._wait_ns(was):
                self._note("hold", f"LAND out of {was.name} after {alone_ns * 1e-9:.3f} s alone")
        if state is not HOLD:
            self._fresh_ns.clear()
        self._is_reset = self._impossible = False

    def _enter_track(self, was: GuardState, now_ns: int) -> None:
        since_ns, self._tracked_ns = now_ns - self._tracked_ns, now_ns
        if since_ns < SETTLE_NS:
            self._note("hold", f"TRACK again after {since_ns * 1e-9:.3f} s")
        if was is HOLD and not self._is_reset:
            self._ramp_until_ns = now_ns + self._ramp_ns
            fresh_ns = self._fresh_ns
            if len(fresh_ns) < RESUME_COMMANDS or fresh_ns[-1] - fresh_ns[0] > RESUME_NS:
                self._note("stale", f"HOLD left for TRACK on {len(fresh_ns)} fresh commands")

    def check_track(self) -> None:
        """Check in TRACK that the last command is still fresh."""
        late = (self._watch.now_ns - self._fresh_until_ns) * 1e-9
        if late > 0.0:
            self._note("stale", f"TRACK, {late:.3f} s after the last fresh command")

    def check_wait(self, state: GuardState) -> None:
        """Check in each step that TRACK has a mission, and that no mission waits too long."""
        if state is TRACK:
            if not self._armed:
                self._note("latch", "TRACK without the operator's start")
            return
        self._impossible = False
        alone_ns = self._watch.now_ns - self._alone_ns
        if self._armed and alone_ns > self._wait_ns(state) + STEP_NS:
            self._note("hold", f"{state.name} for {alone_ns * 1e-9:.3f} s of a mission")
            self._alone_ns += alone_ns

    def _wait_ns(self, state: GuardState) -> float:
        """Return how long the robot may stay in `state` without commands in a mission [ns]."""
        if state is GROUND:
            return max(self._hold_ns, GROUND_NS)
        return self._hold_ns if state is HOLD else inf
