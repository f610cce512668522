# SPDX-License-Identifier: Apache-2.0

"""A key whose value is a name or what the name stands for: a file's contents, a plug-in."""

from __future__ import annotations

from typing import Annotated, Any, TypeVar

from pydantic import ConfigDict, Discriminator, Tag

from cloudrc.config.section import Section


def _name_or_inline(value: Any) -> str:
    return "<name>" if isinstance(value, str) else "<inline>"


_Section = TypeVar("_Section", bound=Section)
NameOr = Annotated[
    Annotated[str, Tag("<name>")] | Annotated[_Section, Tag("<inline>")],
    Discriminator(_name_or_inline),
]
"""The name of a file or plug-in, or its contents."""


class PlugIn(Section):
    """A plug-in by name, and its parameters as further keys."""

    model_config = ConfigDict(extra="allow")
    name: str
    """Name of a plug-in that is shipped or installed, or a path of a Python file"""


PlugInChoice = NameOr[PlugIn]
