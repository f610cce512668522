"""The fault suite: what goes wrong is brought about on purpose, what must follow is checked.

scenario   what a fault is: an injector and the checks of what has to follow
mortal     an end of the tunnel that can be killed, frozen and replaced
flight     a whole flight in virtual time, with everything that can break
watch      the invariants, looked at in every step of the physics
family_*   the scenarios F1 to F40
fuzz       faults composed at random, shrunk when they break an invariant
"""
