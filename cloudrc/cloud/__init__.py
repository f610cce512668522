# SPDX-License-Identifier: Apache-2.0

"""The remote end: it turns the robot's telemetry into velocity commands.

The signal passes through three plug-ins. The operator gives the setpoint:

    telemetry > estimators (how long is the loop delay?)
              > predictors (where will the robot be after this delay?)
              > controllers (which velocity leads to the setpoint?) > command
                                                ^
              operator > teleop (missions) ---- setpoint

A file in `estimators`, `predictors` or `controllers` is a plug-in; the file name is the plug-in's
name. A file whose name begins with an underscore is a helper of the plug-ins.
"""
