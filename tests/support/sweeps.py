# SPDX-License-Identifier: Apache-2.0

"""The file of a short sweep, and results of its flights."""

SHORT = {
    "mission.steps.count": 1,
    "mission.steps.period_s": 1.0,
    "criteria.settle_m": None,
    "link.profile": "paper-p3",
}
"""Settings of `steps` for one second of flight."""
GRID = {"cloud.predictor": ["last_sample", "constant_velocity"], "link.both.delay_ms": [40, 0]}


def flown(verdict="success", *failures, **numbers):
    """Return the result of a flight."""
    text = "" if verdict == "success" else "a reason"
    return {"verdict": verdict, "failures": [*failures], "text": text, "numbers": numbers,
            "records_sha256": "", "physics_steps": "Python"}  # fmt: skip
