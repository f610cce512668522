"""The robot's end of the tunnel: physics, sensors, guard and low-level controller.

    tunnel > guard > low_level > rotor speeds > simulator > readings > sensors > tunnel

`readings` is the interface between the physics and the onboard controller. Only `scene` imports
MuJoCo. Robots and scenes are MJCF files in the folders `robots` and `scenes`; a file's name is the
name in the configuration.
"""
