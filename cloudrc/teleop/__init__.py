"""Teleop: the operator's wishes come in, setpoints for the controller and requests go out.

`plan` says what a mission is, `messages` what teleop is told and tells, `mission` flies it. Teleop
meets the controller and the robot in messages only, so that it can live in another process.
"""
