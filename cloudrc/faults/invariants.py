"""Safety invariants, checked after every 2 ms step, independently of the guard.

fence      The robot's base stays inside the fence while its actuators are on. After a collision or
           an emergency stop the robot may leave the fence by at most `FALL_MAX`. A robot that is
           switched off starts again only if it is at rest inside the fence. On the ground only the
           walls count.
cap, stop  The velocity reference stays within its limits, and the robot can always stop before the
           fence. During LAND the robot may fly down to the floor. After a HOLD the reference
           velocity grows slowly at first. That of a planar robot is horizontal.
stale      World rejects a command that is based on too old odometry. TRACK ends with the session,
           or when the last command's odometry is too old and the command's plan has ended. HOLD
           changes to TRACK only after `RESUME_COMMANDS` fresh commands within `RESUME_NS`.
rest       After TRACK the robot stops within its stopping distance. It is switched off only on a
           request, after a collision, or if it does not move.
collision  If the cloud is honest, only the robot's probe touches something, and it touches only the
           body that the mission names. A robot that lands, or that the operator has stopped, may
           touch anything, because the guard does not know what is below the robot.
latch      The robot is in TRACK only during a mission that the operator has started. LAND and ESTOP
           last until the operator acknowledges them.
hold       At least `SETTLE_NS` pass between two changes to TRACK. In a mission, a robot without
           commands lands after the configured time, or sooner after impossible commands.
order      Each applied command is newer than the last one, and not of an old session.
tick       The guard runs once in each step of the physics.

All limits come from configuration, robot and docs/, not from the guard: from "Stop rule" and
"Leaving HOLD" in reference/plant.md, F5 and F23 in reference/faults.md, and "The guard" in
safety.md. `motion_checks` looks at fence, cap, stop and rest, `contact_checks` at collision and at
what is switched off, `order_checks` at stale, latch and hold.
"""

from __future__ import annotations

from cloudrc.faults.contact_checks import ContactChecks
from cloudrc.faults.motion_checks import MotionChecks
from cloudrc.faults.order_checks import OrderChecks
from cloudrc.faults.watch import FLOWN, LAND, TRACK, Watch
from cloudrc.messages import Command, OperatorRequest, Request, Start
from cloudrc.sim.onboard import Commands
from cloudrc.sim.readings import Readings
from cloudrc.world.robot import STEP_NS, Observer, Robot


class RobotInvariants:
    """Checks one robot after every step of its physics; times are on world's clock [ns]."""

    def __init__(self, robot: Robot, watch: Watch, start_ns: int, honest: bool) -> None:
        """Check a robot from `start_ns` [ns] on; check its contacts only if cloud is `honest`."""
        self._guard, self._simulator, self._watch = robot.guard, robot.simulator, watch
        self._stopped = robot.onboard.stopped
        self._was = self._state = robot.guard.state  # after the last step; after the last event
        self._next_ns, self._steps = start_ns, 0
        self._orders, self._motion = OrderChecks(watch), MotionChecks(watch)
        self._contacts = ContactChecks(watch, robot.simulator, honest=honest)
        watch.starts_ns.append(start_ns)
        tells = self.see_step, self.see_command, self.see_request, self.see_session
        robot.observers.append(Observer(*tells))

    def see_step(self, now_ns: int, readings: Readings, commands: Commands) -> None:
        """Check all invariants in a step that begins at `now_ns` [ns]."""
        steps, was, state = self._simulator.steps, self._was, self._guard.state
        motion, contacts, orders, watch = self._motion, self._contacts, self._orders, self._watch
        watch.now_ns = now_ns
        if now_ns != self._next_ns or steps != self._steps + 1:
            watch.note("tick", "a step of the physics without a tick of the guard")
        self._next_ns, self._steps = now_ns + STEP_NS, steps
        if state is not was:
            orders.check_change(was, state)
            contacts.check_hit(state)
        orders.check_wait(state)
        # Hard braking may command actuators of a robot to 0, too: only the object itself counts.
        is_on = commands is not self._stopped
        contacts.check_actuators(state, readings.velocity, is_on)
        motion.check_fence(was, state, readings)
        if was is TRACK and state is not TRACK:
            motion.leave_track(readings)
        if state in FLOWN:
            contacts.comes_down = state is LAND
            motion.check_reference(self._guard, readings.position, orders.is_ramped)
            if state is TRACK:
                orders.check_track()
            elif is_on:
                motion.check_rest(readings.position)
        elif is_on:
            watch.note("latch", f"actuators on in {state.name}")
        if contacts.check_touches(state):
            motion.touch()
        motion.before = self._guard.reference
        self._was = self._state = state

    def see_command(self, command: Command, rejection: str | None, now_ns: int) -> None:
        """Check an accepted command's age, count invalid ones; `rejection` is None if accepted."""
        self._watch.now_ns = now_ns
        self._orders.see_command(command, rejection, self._state)
        self._state = self._guard.state

    def see_request(self, request: OperatorRequest, now_ns: int) -> None:
        """Store what a request allows the robot to do, which it has carried out at `now_ns`."""
        self._watch.now_ns = now_ns
        if request.request is Request.START and request.start is Start.SPAWN:
            self._steps, self._contacts.is_asked = 0, True
        elif request.request is Request.ESTOP:
            self._contacts.is_asked = True
            if self._state in FLOWN:
                self._motion.falls = self._contacts.comes_down = True
        self._orders.see_request(request, self._state)
        self._state = self._guard.state

    def see_session(self, now_ns: int) -> None:
        """Forget the commands of the old session: the guard has forgotten them, too."""
        self._orders.forget_commands()
