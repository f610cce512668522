"""What teleop's process exposes besides the mission: counts of its API and its journal."""

from __future__ import annotations

from cloudrc.exposition.labels import API_REFUSALS, ORDER_REFUSALS
from cloudrc.exposition.part import Handlers, Readings, by, chosen, plain
from cloudrc.records import Counted


class Api:
    """Requests to the API, and what became of them."""

    def __init__(self) -> None:
        """Begin with none."""
        self._counts: dict[str, int] = {}

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {Counted: self._see_count}

    def _see_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def read(self) -> Readings:
        """See `Part`."""
        of_api = {name.removeprefix("api_"): count for name, count in self._counts.items()}
        return {
            "cloudrc_api_requests_total": plain(of_api.get("served", 0)),
            "cloudrc_api_rejected_total": by(chosen(API_REFUSALS, of_api)),
            "cloudrc_missions_refused_total": by(
                {reason: of_api.get(f"order_{reason}", 0) for reason in ORDER_REFUSALS}
            ),
            "cloudrc_stream_dropped_events_total": plain(of_api.get("events_dropped", 0)),
            "cloudrc_audit_dropped_total": plain(of_api.get("audit_dropped", 0)),
            "cloudrc_journal_repaired_total": plain(of_api.get("journal_repaired", 0)),
        }
