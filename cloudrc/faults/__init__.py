"""Injects faults into flights in virtual time and checks how the system reacts.

scenario, scenarios/   named faults with the checks of what must follow, and their results
measures               what scenarios ask about a flight
schedule, adversary    random faults of one flight; hostile clouds
models, flight         processes, clocks and teleop around the two ends; a whole flight
invariants             what is checked after every step of the physics
trial, search          one schedule, a search over many
"""
