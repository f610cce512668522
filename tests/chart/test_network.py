"""The NetworkPolicies allow tunnel, DNS, API and scraping, nothing else."""

from __future__ import annotations

from typing import Any

from tests.chart.conftest import Object, containers, of_kind, pod_specs, render

TUNNEL, DNS, API = {("UDP", 7400)}, {("UDP", 53), ("TCP", 53)}, {("TCP", 8080)}
LINK_TEST = {("TCP", 9100), ("TCP", 9102)}
PROMETHEUS = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "monitoring"}}}
KUBE_SYSTEM = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "kube-system"}}}


def policies(values: Object | None = None) -> dict[str, Object]:
    return {name: found["spec"] for name, found in of_kind(render(values), "NetworkPolicy").items()}


def ports(rule: Object) -> set[tuple[str, int]]:
    return {(port["protocol"], port["port"]) for port in rule["ports"]}


def peer_name(peer: Any) -> str:
    """Return a component of this release by name, any other peer unchanged."""
    labels = peer.get("podSelector", {}).get("matchLabels", {})
    if labels.get("app.kubernetes.io/instance") == "demo" and len(peer) == 1:
        return str(labels["app.kubernetes.io/component"])
    return str(peer)


def allowed(spec: Object, way: str) -> list[tuple[list[str], set[tuple[str, int]]]]:
    rules = spec.get(way, [])
    peers = [rule.get("from") or rule.get("to") for rule in rules]
    assert all(peers), "a rule without peers admits everybody"
    return [
        (sorted(map(peer_name, found)), ports(rule))
        for found, rule in zip(peers, rules, strict=True)
    ]


def test_traffic_is_tunnel_dns_and_api_only() -> None:
    test, names = (["test"], LINK_TEST), ([str(KUBE_SYSTEM)], DNS)
    wanted = {
        "world": ([(["cloud"], TUNNEL), test], [(["cloud"], TUNNEL), names]),
        "cloud": (
            [(["world"], TUNNEL), (["mission", "test"], API), test],
            [(["world"], TUNNEL), names],
        ),
        "mission": ([], [(["cloud"], API), names]),
        "test": ([], [(["cloud"], API), (["cloud", "world"], LINK_TEST), names]),
    }
    found = policies()
    assert {n: (allowed(s, "ingress"), allowed(s, "egress")) for n, s in found.items()} == wanted
    for name, spec in found.items():
        assert spec["policyTypes"] == ["Ingress", "Egress"]
        labels = spec["podSelector"]["matchLabels"]
        assert labels["app.kubernetes.io/component"] == name
        assert labels["app.kubernetes.io/instance"] == "demo"
    assert policies({"networkPolicy": {"enabled": False}}) == {}


def test_allowed_peers_may_scrape_and_call_the_api() -> None:
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
    found = policies({"teleop": {"allowFrom": [PROMETHEUS]}})
    assert PROMETHEUS in found["cloud"]["ingress"][1]["from"]
    assert all(PROMETHEUS not in rule["from"] for rule in found["world"]["ingress"])


def test_everything_listens_at_both_address_families() -> None:
    flags = ("--listen=", "--metrics=", "--api=")
    objects = render()
    for name in ("world", "cloud"):
        for part in containers(pod_specs(objects)[name]).values():
            listens = [word for word in part["args"] if word.startswith(flags)]
            assert listens
            assert all("=[::]:" in word or "=127.0.0.1:" in word for word in listens)
    services = of_kind(objects, "Service")
    assert all(s["spec"]["ipFamilyPolicy"] == "PreferDualStack" for s in services.values())
    for name in ("world", "cloud"):
        assert services[name]["spec"]["clusterIP"] == "None"
        assert services[name]["spec"]["publishNotReadyAddresses"] is True
    for thing in of_kind(render({"ipFamilyPolicy": None}), "Service").values():
        assert "ipFamilyPolicy" not in thing["spec"]
