"""The onboard guard, which keeps the robot safe whatever the cloud sends."""
