"""The robot's end of the tunnel: physics, sensors, guard and low-level controller.

    tunnel > guard > onboard > actuators > simulator > readings > sensors > tunnel

`readings` is the interface between the physics and the onboard controller. Only `scene` imports
MuJoCo. Scenes are MJCF files in the folder `scenes`; a file's name is the name in the
configuration. Robots are in `cloudrc/robots/`.
"""
