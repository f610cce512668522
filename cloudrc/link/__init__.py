"""The emulated network between world and cloud: profiles, a pure model, a userspace relay."""
