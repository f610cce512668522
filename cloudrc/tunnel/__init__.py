"""The authenticated UDP tunnel between world and cloud."""
