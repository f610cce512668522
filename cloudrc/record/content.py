"""What the file of a recording contains; the reader makes it, and the writer stores it."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from shlex import quote
from typing import TypeAlias

from cloudrc.errors import BadInputError
from cloudrc.record.holes import Hole

Message: TypeAlias = tuple[str, int, bytes]
"""Topic, log time [ns] and CDR bytes of a message."""
FOLLOWED = "something follows its end"
"""What is wrong with a file in which another recording, or a part of one, follows the first."""


@dataclass(eq=False)
class Content:
    """The messages of a file in the form of bytes, and what else the file contains."""

    messages: list[Message] = field(default_factory=list)  # in the order of log times
    metadata: dict[str, str] = field(default_factory=dict)  # of a repeated key, the last value
    attachments: dict[str, bytes] = field(default_factory=dict)  # name -> content of a file
    views: list[Message] = field(default_factory=list)  # messages of `VIEWS`
    source: str = ""  # the file, for errors
    torn: str = ""  # that a killed process has not written the end of the file, in words
    lacking: str = ""  # what was damaged or changed in the file, in words
    told: str = ""  # what the writer of the file missed, in words
    holes: tuple[Hole, ...] = ()  # times in which messages are lost
    remarks: tuple[str, ...] = ()  # what was ignored or sorted; "The recording" precedes each

    def refuse_damaged(self, path: Path) -> None:
        """Raise a BadInputError if the file is torn, damaged or changed; `path` is the file."""
        if wrong := self.lacking or self.torn:
            raise BadInputError(f"{path}: {wrong}{self.remedy(path)}")

    def remedy(self, path: Path) -> str:
        """Return the end of an error about the damaged file `path`: what to do; "" for others."""
        how = f"; to copy what is readable: cloudrc recover {quote(str(path))}"
        is_damaged = self.torn or "damaged" in self.lacking or FOLLOWED in self.lacking
        return how if is_damaged else ""

    def unreadable(self, name: str) -> BadInputError:
        """Return the error that an attachment of an undamaged file is not readable."""
        return BadInputError(
            f"{self.source}: its attachment {name} is not readable, as another program has changed"
            " it; use the recording that cloudrc wrote, or a new copy of it by: cloudrc recover"
        )

    @property
    def note(self) -> str:
        """What is missing or wrong, in words; "" if no message of the flight is missing."""
        lacking = "" if self.lacking in self.told else self.lacking
        return "; ".join(filter(None, (self.torn, lacking, self.told)))
