"""Which release a command means: the named one, or the only one of the namespace; never a guess."""

import pytest

from cloudrc.cluster.client import ClusterError, connect
from cloudrc.cluster.pods import find_deployment
from cloudrc.cluster.releases import only_release
from cloudrc.errors import BadInputError
from tests.cluster.conftest import deployment


def put(api, name, namespace="demo"):
    body = deployment("cloud")
    body["metadata"]["labels"]["app.kubernetes.io/instance"] = name
    body["metadata"] |= {"name": f"{namespace}-{name}-cloud", "namespace": namespace}
    api.put("deployments", body)


def test_the_only_release_is_used_whatever_its_name(api, release):
    put(api, "drone-7")
    assert only_release(release).name == "drone-7"


def test_of_several_releases_none_is_guessed(api, release):
    for name in ("cloudrc", "alpha"):
        put(api, name)
    with pytest.raises(BadInputError, match=r"'demo': alpha, cloudrc; name one: --release NAME"):
        only_release(release)


@pytest.mark.parametrize("find", [only_release, lambda release: find_deployment(release, "cloud")])
def test_the_releases_that_exist_are_named(api, release, find):
    with pytest.raises(ClusterError, match=r"^no release .*in namespace 'demo'; install it: helm"):
        find(release)
    put(api, "robot", "lab")
    with pytest.raises(ClusterError, match=r"there are: 'robot' in namespace 'lab'; name one"):
        find(release)


def test_a_namespace_that_does_not_exist_is_named(api):
    put(api, "cloudrc", "lab")
    release = connect(None, "labb")
    for find in (only_release, lambda release: find_deployment(release, "cloud")):
        with pytest.raises(ClusterError, match=r"^no namespace 'labb'; there are: 'cloudrc' in"):
            find(release)


def test_a_user_of_one_namespace_is_not_asked_for_more_rights(api, release):
    put(api, "other")
    api.refuse["GET", "namespaces"] = 403, "namespaces is forbidden"
    refuse = {"code": 403, "message": "deployments is forbidden"}
    everywhere = "/apis/apps/v1/deployments"
    api.hooks.append(lambda path: (403, refuse) if path.startswith(everywhere) else None)
    with pytest.raises(
        ClusterError, match=r"^no release 'cloudrc' .*: 'other' in namespace 'demo'"
    ):
        find_deployment(release, "cloud")
