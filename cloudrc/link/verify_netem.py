"""What netem makes of a profile: what is asked goes in; what an honest netem does to it comes out.

netem draws a delay by the last bits of a number whose first bits alone resemble those of the number
before, so that of a correlation of jitter nothing is left, and a distribution keeps its width. It
loses either a packet or its copy, and sends the copy through its losses once more. Its bottleneck
is behind the delay, not before it.

Source: Linux, net/sched/sch_netem.c: get_crandom, tabledist, netem_enqueue.
"""

from __future__ import annotations

from dataclasses import fields, replace

from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss, bad_share
from cloudrc.link.verify_corrupt import each_loss, refusing
from cloudrc.link.verify_expect import has_jitter
from cloudrc.link.verify_reference import NetemProfile


def netem_makes(profile: DirectionProfile) -> DirectionProfile:
    """Give the profile that an end meets behind netem, in the reference's terms.

    Args:
        profile: What is asked of netem. A frame that it damages is dropped by its checksum.
    """
    made = replace(profile, correlation=0.0)
    rates = [profile.rate, *(change.rate for change in profile.changes)]
    if any(rates) and has_jitter(profile):
        made = NetemProfile(**{one.name: getattr(made, one.name) for one in fields(made)})
    if not profile.duplicate:
        return refusing(made)
    chance, damage = profile.duplicate, profile.corrupt

    def kept(loss: Loss) -> Loss:
        return _kept(loss, chance, damage)

    # Copies have no time line: they are those of the loss that it begins with.
    copies = _copied(profile.loss, chance, damage)
    return replace(each_loss(made, kept), duplicate=copies, corrupt=0.0)


def _kept(loss: Loss, chance: float, damage: float) -> Loss:
    """Say which packets are lost if each had a copy with this chance: those of which none is left.

    Args:
        loss: Of one packet.
        chance: Of a copy, in [0, 1].
        damage: Chance that one packet is damaged, in [0, 1].
    """

    def share(lost: float) -> float:
        alone = 1.0 - (1.0 - lost) * (1.0 - damage)
        # Lost beside a copy: that one stays, whole or not. Else either may fail by itself.
        return (1.0 - chance) * alone + chance * damage * (lost + (1.0 - lost) * alone)

    if not isinstance(loss, GilbertElliott):
        return share(loss)
    start, end = loss.bad_start, loss.bad_end
    # A copy that is made takes another step of the chain.
    bad, good = (chance * (1.0 - one) for one in (loss.loss_bad, loss.loss_good))
    return replace(
        loss,
        bad_start=start * (1.0 + good * (1.0 - start - end)),
        bad_end=end * (1.0 + bad * (1.0 - start - end)),
        loss_bad=share(loss.loss_bad),
        loss_good=share(loss.loss_good),
    )


def _copied(loss: Loss, chance: float, damage: float) -> float:
    """Say which share of those that arrive do so twice, in [0, 1]; arguments as of `_kept`."""
    if not isinstance(loss, GilbertElliott):
        loss = GilbertElliott(0.0, 1.0, loss, loss)  # never bad
    kept = _kept(loss, chance, damage)
    assert isinstance(kept, GilbertElliott)
    bad, start, end = bad_share(kept), loss.bad_start, loss.bad_end
    passes_bad, passes_good = 1.0 - loss.loss_bad, 1.0 - loss.loss_good
    after_bad = (1.0 - end) * passes_bad + end * passes_good
    after_good = (1.0 - start) * passes_good + start * passes_bad
    twice = bad * passes_bad * after_bad + (1.0 - bad) * passes_good * after_good
    there = 1.0 - bad * kept.loss_bad - (1.0 - bad) * kept.loss_good
    return chance * twice * (1.0 - damage) ** 2 / there if there > 0.0 else 0.0
