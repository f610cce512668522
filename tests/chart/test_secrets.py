# SPDX-License-Identifier: Apache-2.0

"""Key and tokens are made once and kept; a container mounts no more than it needs."""

import base64

import pytest

from tests.chart.conftest import a_namespace, notes, of_kind, pod_specs, render


def test_key_and_tokens_are_made_once_and_kept():
    installed = render(lookup=a_namespace())
    secrets = of_kind(installed, "Secret")
    assert len(base64.b64decode(secrets["tunnel"]["data"]["key"])) == 32
    data = secrets["tokens"]["data"]
    operator, reader = (base64.b64decode(data[role]) for role in ("operator", "reader"))
    assert len(operator) == len(reader) == 48
    assert operator != reader
    assert render(lookup=a_namespace(objects=installed)) == installed
    for secret in secrets.values():
        assert secret["metadata"]["annotations"]["helm.sh/resource-policy"] == "keep"


@pytest.mark.parametrize(
    ("values", "name", "made"),
    [
        ("secret: {existingSecret: lab-key}", "lab-key", "generic lab-key"),
        ("teleop: {tokens: {existingSecret: lab-tokens}}", "lab-tokens", "--from-file=operator"),
    ],
)
def test_a_missing_secret_is_refused_with_a_command(values, name, made):
    said = f"no Secret '{name}' in namespace 'lab'; make it: .* {made}"
    with pytest.raises(Exception, match=said):
        render(values, lookup=a_namespace())


def test_secrets_are_in_no_output_and_no_environment():
    objects, printed = render("mission: {enabled: true}"), notes()
    assert not any("secretKeyRef" in str(pod) for pod in pod_specs(objects).values())
    for secret in of_kind(objects, "Secret").values():
        for text in secret["data"].values():
            assert text not in printed
            assert base64.b64decode(text).decode("latin-1") not in printed
