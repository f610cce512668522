# SPDX-License-Identifier: Apache-2.0

"""Inject faults into flights in virtual time, and check how the system reacts.

scenarios/             named faults with checks of the required reaction
measures               checks, their result, and measurements in a flight for them
schedule, inject       random faults of one flight, and how they are injected
adversary              dishonest clouds
models, flight         models of processes, clocks and teleop; a whole flight
observer, rules        what a robot does in every step, and the limits of robot and scene
invariants             safety rules: predicates over the steps of a flight
trial                  fly one schedule of faults
search                 fly random schedules for a time: python -m tests.faults.search
"""
