"""What keeps two ends from having a session, in words for the user, and each only once."""

from __future__ import annotations

from cloudrc.records import Fault
from cloudrc.tunnel.codec import LAST_GREETING, VERSION, peek

KEY = "greetings come that our key does not fit: give both ends the same key file"
BUSY = "another cloud controls the robot: this one waits until that is silent"
NO_EPOCH = "no session and no mission from the spawn can begin: the disk keeps the epochs waiting"
SILENCE = "world does not answer: is it running, is the link up, do both ends have the same key?"


class Complaints:
    """Remembers what has been said since the last session began."""

    def __init__(self) -> None:
        """Begin with nothing said."""
        self._said: set[str] = set()

    def forget(self) -> None:
        """There is a session again."""
        self._said.clear()

    def about(self, outcome: str, data: bytes, now_ns: int) -> list[Fault]:
        """Explain a refused datagram while there is no session [ns, own clock]."""
        if outcome == "version":
            text = (
                f"peer speaks v{data[0]}, we speak v{VERSION}: "
                "run the same version of cloudrc at both ends"
            )
            return self.say("version", text, now_ns)
        if outcome == "tag" and peek(data)[0] <= LAST_GREETING:
            return self.say("key", KEY, now_ns)
        return []

    def say(self, code: str, text: str, now_ns: int) -> list[Fault]:
        """Say something unless these words have been said [ns, own clock].

        Anybody may send a datagram of another version: it does not hide what the peer's is.
        """
        if text in self._said:
            return []
        self._said.add(text)
        return [Fault(now_ns, code, text)]
