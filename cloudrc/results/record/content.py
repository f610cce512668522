# SPDX-License-Identifier: Apache-2.0

"""What the file of a recording contains; the reader makes it, and the writer stores it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeAlias

from cloudrc.results.record.holes import Hole

Message: TypeAlias = tuple[str, int, bytes]
"""Topic, log time [ns] and CDR bytes of a message."""


@dataclass(eq=False)
class Content:
    """The messages of a file in the form of bytes, and what else the file contains."""

    messages: list[Message] = field(default_factory=list)  # in the order of log times
    metadata: dict[str, str] = field(default_factory=dict)  # of a repeated key, the last value
    attachments: dict[str, bytes] = field(default_factory=dict)  # name -> content of a file
    views: list[Message] = field(default_factory=list)  # messages of `VIEWS`
    source: str = ""  # the file, for errors
    lacking: str = ""  # what is cut off, damaged or changed, as the reader found it, in words
    told: str = ""  # what the writer of the file missed, in words
    holes: tuple[Hole, ...] = ()  # times in which messages are lost
    remarks: tuple[str, ...] = ()  # what was ignored or sorted; "The recording" precedes each
    unread: int = 0  # number of bytes of the file that are cut off or behind its damage

    @property
    def note(self) -> str:
        """What is missing or wrong, in words; "" if no message of the flight is missing."""
        lacking = "" if self.lacking in self.told else self.lacking  # of a copy
        return "; ".join(filter(None, (lacking, self.told)))
