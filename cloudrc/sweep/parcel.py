"""Pack flights of a sweep into a file for pods, which have none of the user's files.

The file contains each resolved point once, and the point and seed of each flight.
"""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterable
from pathlib import Path

from cloudrc.config.load import ResolvedExperiment
from cloudrc.errors import BadInputError
from cloudrc.sweep.plan import Flight, flight_key


def pack(flights: Iterable[Flight]) -> bytes:
    """Return the content of the file; equal flights give equal bytes."""
    points: dict[int, int] = {}  # identity of a resolved point -> its index
    shown, chosen = [], []
    for flight in flights:
        if id(flight.resolved) not in points:
            points[id(flight.resolved)] = len(points)
            shown.append([flight.point, flight.resolved.model_dump(mode="json")])
        chosen.append([points[id(flight.resolved)], flight.seed])
    text = json.dumps({"points": shown, "flights": chosen})
    return gzip.compress(text.encode(), mtime=0)


def unpack(path: Path) -> list[Flight]:
    """Read the flights of a file; raise a BadInputError if this version cannot fly them."""
    try:
        content = json.loads(gzip.decompress(path.read_bytes()))
        points = [
            (point, ResolvedExperiment.model_validate_json(json.dumps(values)))
            for point, values in content["points"]
        ]
        return [
            Flight(flight_key(points[index][1], seed), points[index][0], seed, points[index][1])
            for index, seed in content["flights"]
        ]
    except (OSError, EOFError, ValueError, LookupError, TypeError) as error:
        text = f"is not a file of flights of this version of cloudrc ({type(error).__name__})"
        raise BadInputError(f"{path}: {text}; use an image of the same version") from error
