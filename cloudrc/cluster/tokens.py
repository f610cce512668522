"""Tokens of a release's API: the Secret that its cloud pod mounts, read with the user's rights."""

from __future__ import annotations

import base64
import binascii

from cloudrc.cluster.access import REQUEST_TIMEOUT, Release
from cloudrc.cluster.errors import ClusterError, explained
from cloudrc.cluster.pods import find_pod

VOLUME = "tokens"
"""In the cloud pod and in missions' pods."""
OPERATOR = "operator"
"""Key of the Secret, and name of the file."""


def secret_name(release: Release) -> str:
    """Say which Secret has the tokens.

    Raises:
        ClusterError: If the release has none.
    """
    for volume in find_pod(release, "cloud").spec.volumes or []:
        if volume.name == VOLUME and volume.secret is not None:
            return str(volume.secret.secret_name)
    raise ClusterError(
        f"release '{release.name}' {release.where} mounts no tokens: it is of another version; "
        "upgrade it: helm upgrade"
    )


def operator_token(release: Release) -> str:
    """Read the operator's token; needs the right to get Secrets.

    Raises:
        ClusterError: If it cannot be read; the text has no token in it.
    """
    name = secret_name(release)
    with explained("get secrets", release.where):
        secret = release.core.read_namespaced_secret(
            name, release.namespace, _request_timeout=REQUEST_TIMEOUT
        )
    try:
        return (
            base64.b64decode((secret.data or {})[OPERATOR], validate=True).decode("ascii").strip()
        )
    except (KeyError, ValueError, binascii.Error):
        raise ClusterError(
            f"Secret '{name}' {release.where} has no token under '{OPERATOR}'; "
            "name a file that has it: --token-file"
        ) from None
