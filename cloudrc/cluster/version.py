"""How old a cluster is: a place comes in, the version of its API server goes out."""

from __future__ import annotations

import re

from cloudrc.cluster.access import Release
from cloudrc.cluster.errors import ClusterError, explained

OLDEST = (1, 29)
"""Kubernetes that the chart runs on; the same as kubeVersion in its Chart.yaml."""
ANSWER_LIMIT = 5.0
"""For the API server to say its version [s]."""


def server_version(release: Release) -> tuple[int, int]:
    """Ask the API server for its version.

    Returns:
        Major and minor.

    Raises:
        ClusterError: If it does not answer, or refuses.
    """
    with explained("get the version", release.where):
        code = release.version.get_code(_request_timeout=ANSWER_LIMIT)
    # Minor is "29+" where the cluster's vendor has added something.
    found = [re.match(r"\d+", str(text)) for text in (code.major, code.minor)]
    if not all(found):
        raise ClusterError(f"the API server {release.where} calls itself {code.git_version}")
    major, minor = (int(match.group()) for match in found if match)
    return major, minor
