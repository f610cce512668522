"""The UDP tunnel between world and cloud: bytes, sessions, and which datagram counts."""
