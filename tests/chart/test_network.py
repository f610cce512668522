"""The NetworkPolicies allow tunnel, DNS, API and scraping, nothing else."""

from __future__ import annotations

from typing import Any

from tests.chart.conftest import Object, containers, of_kind, pod_specs, render

TUNNEL, DNS, API = {("UDP", 7400)}, {("UDP", 53), ("TCP", 53)}, {("TCP", 8080)}
LINK_TEST = {("TCP", 9100), ("TCP", 9102)}
PROMETHEUS = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "monitoring"}}}


def policies(values: Object | None = None) -> dict[str, Object]:
    return {name: found["spec"] for name, found in of_kind(render(values), "NetworkPolicy").items()}


def ports(rule: Object) -> set[tuple[str, int]]:
    return {(port["protocol"], port["port"]) for port in rule["ports"]}


def peers(rule: Object) -> list[str]:
    """Return the peers of a rule: components of this release by name, others unchanged."""
    found = rule.get("from") or rule.get("to")
    assert found, "a rule without peers admits everybody"
    return sorted(map(_peer, found))


def _peer(peer: Any) -> str:
    labels = peer.get("podSelector", {}).get("matchLabels", {})
    if labels.get("app.kubernetes.io/instance") == "demo" and len(peer) == 1:
        return str(labels["app.kubernetes.io/component"])
    return str(peer)


def said(spec: Object, way: str) -> list[tuple[list[str], set[tuple[str, int]]]]:
    return [(peers(rule), ports(rule)) for rule in spec.get(way, [])]


def test_every_pod_has_ingress_and_egress_policies() -> None:
    found = policies()
    assert found.keys() == {"world", "cloud", "mission", "test"}
    for name, spec in found.items():
        assert spec["policyTypes"] == ["Ingress", "Egress"]
        labels = spec["podSelector"]["matchLabels"]
        assert labels["app.kubernetes.io/component"] == name
        assert labels["app.kubernetes.io/instance"] == "demo"


def test_ingress_is_tunnel_and_api_only() -> None:
    found = policies()
    test = (["test"], LINK_TEST)
    assert said(found["world"], "ingress") == [(["cloud"], TUNNEL), test]
    assert said(found["cloud"], "ingress") == [
        (["world"], TUNNEL),
        (["mission", "test"], API),
        test,
    ]
    assert said(found["mission"], "ingress") == said(found["test"], "ingress") == []


def test_egress_is_tunnel_dns_and_api_only() -> None:
    found = policies()
    kube_system = str(
        {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "kube-system"}}}
    )
    names = ([kube_system], DNS)
    assert said(found["world"], "egress") == [(["cloud"], TUNNEL), names]
    assert said(found["cloud"], "egress") == [(["world"], TUNNEL), names]
    assert said(found["mission"], "egress") == [(["cloud"], API), names]
    assert said(found["test"], "egress") == [
        (["cloud"], API),
        (["cloud", "world"], LINK_TEST),
        names,
    ]


def test_allowed_peers_may_scrape_all_metrics_ports() -> None:
    found = policies({"metrics": {"allowFrom": [PROMETHEUS]}})
    for end in ("world", "cloud"):
        rule = found[end]["ingress"][-1]
        assert rule["from"] == [PROMETHEUS]
        served = {
            port["containerPort"]
            for container in containers(pod_specs(render())[end]).values()
            for port in container["ports"]
            if port["name"].endswith("metrics")
        }
        assert ports(rule) == {("TCP", port) for port in served}


def test_allowed_peers_may_call_the_api() -> None:
    found = policies({"teleop": {"allowFrom": [PROMETHEUS]}})
    assert PROMETHEUS in found["cloud"]["ingress"][1]["from"]
    assert all(PROMETHEUS not in rule["from"] for rule in found["world"]["ingress"])


def test_policies_can_be_disabled() -> None:
    assert policies({"networkPolicy": {"enabled": False}}) == {}


def test_everything_listens_at_both_address_families() -> None:
    flags = ("--listen=", "--metrics=", "--api=")
    objects = render()
    for name in ("world", "cloud"):
        for part in containers(pod_specs(objects)[name]).values():
            listens = [word for word in part["args"] if word.startswith(flags)]
            assert listens
            assert all("=[::]:" in word or "=127.0.0.1:" in word for word in listens)
    policies = [
        thing["spec"].get("ipFamilyPolicy") for thing in of_kind(objects, "Service").values()
    ]
    assert policies == ["PreferDualStack"] * 3
    for thing in of_kind(render({"ipFamilyPolicy": None}), "Service").values():
        assert "ipFamilyPolicy" not in thing["spec"]
