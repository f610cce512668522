"""A metric that raises."""

UNIT = "m"


def measure(flight):
    raise KeyError("the metric of the net")
