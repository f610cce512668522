# SPDX-License-Identifier: Apache-2.0

"""The robot's end: physics, sensors, guard and low-level controller.

    tunnel > guard > onboard > actuators > simulator > readings > sensors > tunnel

The physics is `physics/sim/`. Scenes are MJCF files in the folder `scenes`; a file's name is the
name in the configuration. Robots are in `robots/`.
"""
