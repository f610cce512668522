"""The robot's end of the loop: physics, sensors, guard and low-level controller.

    tunnel > guard > low_level > rotor speeds > simulator > readings > sensors > tunnel

`readings` is the interface between physics and onboard part. Only `scene` imports MuJoCo. Robots
and scenes are MJCF files in `robots/` and `scenes/`; their file name is their configuration name.
"""
