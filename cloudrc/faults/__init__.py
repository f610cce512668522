"""Inject faults into flights in virtual time, and check how the system reacts.

scenarios/             named faults with checks of the required reaction
measures               checks, their result, and measurements in a flight for them
schedule, inject       random faults of one flight, and how they are injected
adversary              dishonest clouds
models, flight         models of processes, clocks and teleop; a whole flight
invariants             safety rules, checked after every step of the physics
trial                  fly one schedule of faults
"""
