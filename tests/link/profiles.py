# SPDX-License-Identifier: Apache-2.0

"""Profiles in SI units, for short tests. They are not checked."""

from dataclasses import replace

from cloudrc.link.profile import Blackout, Change, DirectionProfile, GilbertElliott

IN_FILES = {
    "at": ("at_s", 1.0),
    "delay": ("delay_ms", 1e3),
    "jitter": ("jitter_ms", 1e3),
    "rate": ("rate_kbit", 1e-3),
}
"""Name of a quantity -> its key in a profile, and factor from SI units to the key's unit."""


def keys(names, values, more):
    """Return keys and values of a file; `names` are those of the positional `values`."""
    found = {}
    for name, value in {**dict(zip(names, values, strict=False)), **more}.items():
        key, scale = IN_FILES.get(name, (name, None))
        found[key] = value * scale if scale and value is not None else value
    return found


def profile_of(*values, **more):
    """Make the profile of a direction: delay [s], jitter [s], distribution, correlation, loss."""
    names = ("delay", "jitter", "distribution", "correlation", "loss")
    return DirectionProfile(**keys(names, values, more))


def changed(profile, **values):
    """Return a profile with other values."""
    return replace(profile, **keys((), (), values))


def change(*values, **more):
    """Make a change: time [s], delay [s], jitter [s], loss, rate [bit/s]."""
    return Change(**keys(("at", "delay", "jitter", "loss", "rate"), values, more))


def blackout(start, duration):
    """Make an interval without packets [s]."""
    return Blackout(start_s=start, duration_s=duration)


def in_bursts(bad_start, bad_end, loss_bad=1.0, loss_good=0.0, delay_bad=0.0):
    """Make losses in bursts, also bursts that never end; `delay_bad` is an extra delay [s]."""
    return GilbertElliott(
        bad_start=bad_start,
        bad_end=bad_end,
        loss_bad=loss_bad,
        loss_good=loss_good,
        delay_bad_ms=delay_bad * 1e3,
    )
