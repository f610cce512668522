"""The tests of the exercise and their points."""

POINTS = {
    "estimator": {"mean": 10, "hold time": 5, "steps": 10},
    "predictor": {"position": 6, "orientation": 5, "velocity, stamp": 4, "steps": 10},
    "controller": {"P": 5, "I": 4, "D": 3, "limit": 3, "steps": 10},
    "together": {"paper, paper-p2": 10, "paper, satellite": 15},
}
"""Part, or all parts together -> test -> points; 100 points in total."""
