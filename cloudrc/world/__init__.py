"""The robot's end of the loop: commands come in through the tunnel, telemetry goes out.

    tunnel > guard > low_level > rotor speeds > simulator > readings > sensors > tunnel

`readings` is the seam between physics and onboard part. MuJoCo is imported in `scene` only; robots
and scenes are MJCF files in `robots/` and `scenes/`, found by their name.
"""
