"""Trials: conditions x seeds are planned, played in processes, kept as rows and summarised."""
