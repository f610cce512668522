# SPDX-License-Identifier: Apache-2.0

"""The tutorial on a cluster works, in a namespace of its own."""

import os
import shutil

import pytest

from tests.e2e.conftest import NAMESPACE, ROOT, command
from tests.tutorials import Reader

OWN = f"{NAMESPACE}-tutorial"


@pytest.mark.real_time
@pytest.mark.full
@pytest.mark.usefixtures("cluster")
def test_the_tutorial_on_a_cluster_works(tmp_path):
    """Its commands are typed in the clone; a kubeconfig of its own names the namespace."""
    own = tmp_path / "kubeconfig"
    shutil.copy(os.environ["KUBECONFIG"], own)
    set_namespace = ("config", "set-context", "--current", f"--namespace={OWN}")
    command("kubectl", f"--kubeconfig={own}", *set_namespace)
    command("kubectl", "create", "namespace", OWN)
    try:
        reader = Reader(ROOT, "a cluster", "a session", KUBECONFIG=str(own))
        reader.play("docs/tutorials/cluster.md", left_out="only without a cluster")
    finally:
        command("kubectl", "delete", "namespace", OWN, "--wait=false")
