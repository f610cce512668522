"""Teleop: turn the operator's verbs into missions, setpoints and requests to the robot.

`wire` defines plans and messages, `mission` flies a mission, `requests` repeats requests to the
robot, and `service` keeps all missions. Teleop exchanges only messages with controller and robot,
so it can run in another process.
"""
