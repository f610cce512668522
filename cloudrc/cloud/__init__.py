"""Cloud: telemetry of the robot comes in, velocity commands for it go out.

The signal flows through three plug-ins and is steered by the operator:

    telemetry > estimators (how long is the loop?) > predictors (where will the robot be by then?)
              > controllers (how to get to the setpoint?) > command
                                                ^
              operator > teleop (missions) ---- setpoint

A file in `estimators`, `predictors` or `controllers` is a plug-in under its own name; a name that
begins with an underscore is a helper of the others.
"""
