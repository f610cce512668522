# SPDX-License-Identifier: Apache-2.0

"""The robot's end of the tunnel: physics, sensors, guard and low-level controller.

    tunnel > guard > onboard > actuators > simulator > readings > sensors > tunnel

The physics is `cloudrc.sim`. Scenes are MJCF files in the folder `scenes`; a file's name is the
name in the configuration. Robots are in `cloudrc/robots/`.
"""
