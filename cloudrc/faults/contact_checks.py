"""Check what the robot touches, and when it is switched off: invariants collision and rest."""

from __future__ import annotations

from cloudrc.faults.watch import ESTOP, FLOWN, HOLD, LAND, REELS_NS, Watch
from cloudrc.messages import GuardState, Vector
from cloudrc.records import Contact
from cloudrc.sim.simulator import Simulator

STANDS = 0.2  # speed per axis up to which a robot stands when it is switched off [m/s]
FALL = 1.0
"""Downward speed that proves a fall while switched off [m/s]; a drop of 2 cm ends at only 0.7."""
BRAKE_NS = 200_000_000  # time to stop a descent that the operator has acknowledged [ns]
FLOOR = "floor"  # body on which a robot may always stand


class ContactChecks:
    """Checks a robot's contacts and actuators in every step.

    Attributes:
        comes_down: Whether the robot lands, or fell after an emergency stop.
        is_asked: Whether the operator has just asked to stop or to reset the robot.
    """

    def __init__(self, watch: Watch, simulator: Simulator, *, honest: bool) -> None:
        self._watch, self._note = watch, watch.note
        self._simulator, self._honest = simulator, honest
        self._touches, self._seen = simulator.touches, 0
        self._landed_ns = -2 * BRAKE_NS
        self.comes_down = self.is_asked = False
        self._was_on = self._halted = False

    def check_touches(self, state: GuardState) -> bool:
        """Check that new contacts are allowed; return whether there are any."""
        if state is LAND:
            self._landed_ns = self._watch.now_ns
        touches = self._simulator.touches
        if touches is not self._touches:
            self._touches, self._seen = touches, 0
        new = touches[self._seen :]
        self._seen = len(touches)
        if self._watch.planar:  # its wheels always touch the floor
            new = [touch for touch in new if touch.body != FLOOR]
        for touch in new:
            if self._honest and not self._is_allowed(state, touch):
                self._note("collision", f"touched {touch.body} in {state.name}")
        return bool(new)

    def _is_allowed(self, state: GuardState, touch: Contact) -> bool:
        """Return whether the robot may touch a body in this state."""
        if touch.body == self._watch.touched and touch.by_probe:
            return True
        # A landing that is acknowledged just above an obstacle cannot stop in time.
        just_landed = self._watch.now_ns - self._landed_ns <= BRAKE_NS
        lands = state is LAND or (state is HOLD and just_landed)
        low = lands or state not in FLOWN
        return low and (lands or self.comes_down or touch.body == FLOOR)

    def check_actuators(self, state: GuardState, velocity: Vector, is_on: bool) -> None:
        """Check that the robot is switched off only on a request, after a hit, or without motion.

        `velocity` is that of the base [m/s], `is_on` tells whether the robot is switched on.
        """
        asked, self.is_asked = self.is_asked, False
        if self._was_on and not is_on:
            self._halted = not asked and state is not ESTOP
            fastest = max(map(abs, velocity))
            if self._halted and not fastest <= STANDS:
                self._note("rest", f"switched off in {state.name} at {fastest:.2f} m/s")
        elif self._halted:
            self._halted = not is_on and not asked and not self._check_fall(state, velocity)
        self._was_on = is_on

    def _check_fall(self, state: GuardState, velocity: Vector) -> bool:
        """Check a robot that was switched off by itself; return whether it falls."""
        falls = velocity[2] < -FALL and not self._just_touched
        if falls:
            self._note("rest", f"falls in {state.name}, switched off in the air")
        return falls

    def check_hit(self, state: GuardState) -> None:
        """Check a change to `state`: only a contact makes the guard stop the robot by itself."""
        is_hit = state is ESTOP and not self.is_asked
        if is_hit and self._honest and not self._just_touched:
            self._note("collision", "stopped by a hit although nothing was touched")

    @property
    def _just_touched(self) -> bool:
        return self._simulator.touch_age <= REELS_NS * 1e-9
