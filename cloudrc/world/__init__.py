"""The robot's end of the loop: physics, sensors, guard and low-level controller.

    tunnel > guard > low_level > rotor speeds > simulator > readings > sensors > tunnel

`readings` is the interface between the physics and the onboard part. Only `scene` imports MuJoCo.
Robots and scenes are MJCF files in `robots/` and `scenes/`; the file name of each is its
configuration name.
"""
