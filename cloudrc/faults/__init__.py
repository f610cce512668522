"""Inject faults into flights in virtual time, and check how the system reacts.

scenario, scenarios/   named faults with checks of the required reaction
measures               measurements in a flight, for the checks of the scenarios
schedule, adversary    random faults of one flight; dishonest clouds
models, flight         models of processes, clocks and teleop; a whole flight
invariants             safety rules, checked after every step of the physics
trial                  fly one schedule of faults
"""
