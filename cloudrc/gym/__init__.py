# SPDX-License-Identifier: Apache-2.0

"""A link between an environment of gymnasium and its policy: in virtual time.

The import registers `cloudrc/Networked-v0`, `cloudrc/Steps-v0`, `cloudrc/Pipes-v0` and
`cloudrc/Linear-v0`.
"""

from cloudrc.base.errors import MissingPrerequisiteError

try:
    import gymnasium as _gymnasium  # noqa: F401
except ImportError:
    raise MissingPrerequisiteError(
        "cloudrc.gym needs gymnasium (not installed); run: pip install 'cloudrc[gym]'"
    ) from None

from cloudrc.gym.channel import Channel
from cloudrc.gym.networked import Networked
from cloudrc.gym.registration import register as _register
from cloudrc.gym.schedules import Waiting
from cloudrc.gym.vector import NetworkedVector

__all__ = ["Channel", "Networked", "NetworkedVector", "Waiting"]

_register()
