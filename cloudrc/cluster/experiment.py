"""The experiment of a release: its ConfigMap is found, the text in it goes out as it was given."""

from __future__ import annotations

from cloudrc.cluster.access import REQUEST_TIMEOUT, Release
from cloudrc.cluster.errors import explained

COMPONENT = "experiment"
FILE = "experiment.yaml"


def experiment_text(release: Release) -> str:
    """Read what a release was told to fly, as YAML; "" if it does not say.

    Raises:
        ClusterError: If the ConfigMap cannot be read.
    """
    with explained("list configmaps", release.where):
        found = release.core.list_namespaced_config_map(
            release.namespace,
            label_selector=release.selector(COMPONENT),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    return next((str((each.data or {}).get(FILE, "")) for each in found), "")
