"""The NetworkPolicies allow tunnel, DNS, API and scraping, nothing else."""

from tests.chart.conftest import containers, metrics_ports, of_kind, pod_specs, render

TUNNEL, DNS, API = {("UDP", 7400)}, {("UDP", 53), ("TCP", 53)}, {("TCP", 8080)}
LINK_TEST = {("TCP", 9100), ("TCP", 9102)}
PROMETHEUS, KUBE_SYSTEM = (
    {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": name}}}
    for name in ("monitoring", "kube-system")
)


def policies(values=None):
    return {name: found["spec"] for name, found in of_kind(render(values), "NetworkPolicy").items()}


def ports(rule):
    return {(port["protocol"], port["port"]) for port in rule["ports"]}


def peer_name(peer):
    """Return a component of this release by name, any other peer unchanged."""
    labels = peer.get("podSelector", {}).get("matchLabels", {})
    if labels.get("app.kubernetes.io/instance") == "demo" and len(peer) == 1:
        return labels["app.kubernetes.io/component"]
    return str(peer)


def allowed(spec, way):
    rules = spec.get(way, [])
    peers = [rule.get("from") or rule.get("to") for rule in rules]
    assert all(peers), "a rule without peers admits everybody"
    names = (sorted(map(peer_name, found)) for found in peers)
    return list(zip(names, map(ports, rules), strict=True))


def test_traffic_is_tunnel_dns_and_api_only():
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


def test_allowed_peers_may_scrape_and_call_the_api():
    found, pods = policies({"metrics": {"allowFrom": [PROMETHEUS]}}), pod_specs(render())
    for end in ("world", "cloud"):
        rule = found[end]["ingress"][-1]
        assert rule["from"] == [PROMETHEUS]
        assert ports(rule) == {("TCP", port) for port in metrics_ports(pods[end]).values()}
    found = policies({"teleop": {"allowFrom": [PROMETHEUS]}})
    assert PROMETHEUS in found["cloud"]["ingress"][1]["from"]
    assert all(PROMETHEUS not in rule["from"] for rule in found["world"]["ingress"])


def test_everything_listens_at_both_address_families():
    objects = render()
    for name in ("world", "cloud"):
        for part in containers(pod_specs(objects)[name]).values():
            flags = ("--listen=", "--metrics=", "--api=")
            listens = [word for word in part["args"] if word.startswith(flags)]
            assert listens
            assert all("=[::]:" in word or "=127.0.0.1:" in word for word in listens)
    services = of_kind(objects, "Service")
    assert all(s["spec"]["ipFamilyPolicy"] == "PreferDualStack" for s in services.values())
    for thing in of_kind(render({"ipFamilyPolicy": None}), "Service").values():
        assert "ipFamilyPolicy" not in thing["spec"]
