"""Measure cloudrc beside gym-pybullet-drones in one run: physics at 500 Hz, control at 100 Hz.

    pip install 'setuptools<81' git+https://github.com/learnsyslab/gym-pybullet-drones
    python -m tools.rival

In gym-pybullet-drones, one drone hovers under its PID controller, without window and recording.
cloudrc flies the experiment `paper`: with the link, the contact with the board, and records kept.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import version

import numpy as np

from cloudrc.config.load import load_experiment
from cloudrc.runs.bench import LOOP, STEP, flight, measure
from cloudrc.text import table

SECONDS = 10
"""Duration of the flight of gym-pybullet-drones, in virtual time [s]."""
STEPS = 5  # of physics in a period of the controller


def rival() -> Callable[[], int]:
    """Prepare a flight of gym-pybullet-drones; return a function that flies and counts steps."""
    from gym_pybullet_drones.control.DSLPIDControl import DSLPIDControl
    from gym_pybullet_drones.envs.CtrlAviary import CtrlAviary
    from gym_pybullet_drones.utils.enums import DroneModel

    start = np.array([[0.0, 0.0, 0.5]])
    env = CtrlAviary(pyb_freq=500, ctrl_freq=100, initial_xyzs=start)
    controller, speeds = DSLPIDControl(DroneModel.CF2X), np.zeros((1, 4))
    env.reset()

    def play() -> int:
        for _ in range(100 * SECONDS):
            states, *_ = env.step(speeds)
            speeds[0], *_ = controller.computeControlFromState(0.01, states[0], start[0])
        env.close()
        assert abs(states[0, 2] - 0.5) < 0.1, "their drone does not hover"
        return 100 * SECONDS * STEPS

    return play


if __name__ == "__main__":
    name = f"gym-pybullet-drones {version('gym-pybullet-drones')}"
    experiment = load_experiment("paper")
    parts = {name: rival, LOOP: lambda: flight(experiment)}
    costs = measure(parts, int(sys.argv[1]) if len(sys.argv) > 1 else 7)
    rows = [("physics 500 Hz, control 100 Hz", "us a step", "x real time", "times faster")]
    for part, cost in costs.items():
        rows.append((part, f"{cost * 1e6:.2f}", f"{STEP / cost:.0f}", f"{costs[name] / cost:.2f}"))
    print(table(rows, right=(1, 2, 3)))
