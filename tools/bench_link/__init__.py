"""`make bench-link`: what the relay does, measured against what was asked of it."""
