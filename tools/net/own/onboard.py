"""Onboard controller of a user: that of multirotors; or one that raises after a while."""

from cloudrc.robots.onboard import multirotor


class Late:
    def __init__(self, inner):
        self.inner, self.count, self.stopped = inner, 0, inner.stopped

    def reset(self):
        self.inner.reset()

    def update(self, readings, velocity, yaw_rate):
        self.count += 1
        if self.count > 3000:
            raise RuntimeError("the onboard controller of the net")
        return self.inner.update(readings, velocity, yaw_rate)

    def brake(self, readings, velocity):
        return self.inner.brake(readings, velocity)


def build(model, fails: bool = False):
    inner = multirotor.build(model)
    return Late(inner) if fails else inner
