"""Injects faults into flights in virtual time and checks how the system reacts.

scenario, scenarios/     named faults with the checks of what must follow
schedule, injection      random faults of one flight, and how they are injected
adversary, datagrams     hostile clouds and hostile datagrams
models, flight           processes, clocks and teleop around the two ends; a whole flight
invariants, hold_invariants    what is checked after every step of the physics
measures                 what scenarios ask about a flight
trial, search, report    one schedule, a search over many, the results
"""
