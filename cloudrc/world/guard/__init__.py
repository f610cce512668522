"""The onboard guard: it keeps the robot safe, whatever the cloud sends."""
