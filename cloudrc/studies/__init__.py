"""Studies with trials: sweep, compare, margin, identify."""
