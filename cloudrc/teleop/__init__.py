"""Teleop: turn the operator's verbs into missions, setpoints and requests to the robot.

`wire` defines plans and messages, `mission` flies a mission, `requests` repeats requests to the
robot, and `service` keeps all missions. Teleop communicates with controller and robot only by
messages, so teleop can run in a separate process.
"""
