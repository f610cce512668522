"""The chart's values as objects: the one place that knows every value, its unit and its default.

`chart_docs.py` writes values.yaml, values.schema.json and the README's tables from here. Keys are
camelCase in the chart; below `experiment` they are those of an experiment file.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from cloudrc.config.schema import Experiment, Mission, Profile
from tools.chart_kubernetes import Peer, Quantity, Resources, Selector, Texts, Values, resources

Seconds = Annotated[int, Field(ge=0)]
ObjectName = Annotated[str, Field(pattern=r"^$|^[a-z]([-a-z0-9]*[a-z0-9])?$")]
Name = Annotated[str, Field(pattern=r"^$|^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$")]


class ImageOf(Values):
    """The image of one role."""

    repository: str = Field(description="Name below the registry")
    digest: Annotated[str, Field(pattern=r"^$|^sha256:[0-9a-f]{64}$")] = Field(
        "", description="sha256:...; wins over the tag"
    )


class Image(Values):
    """Which images the pods run."""

    registry: str = Field(
        "", description="Put before both repositories, without a slash at its end"
    )
    tag: Annotated[str, Field(pattern=r"^$|^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$")] = Field(
        "", description="Tag of both images; default: the chart's appVersion"
    )
    pull_policy: Literal["Always", "IfNotPresent", "Never"] = Field(
        "IfNotPresent", description="When to pull"
    )
    pull_secrets: tuple[str, ...] = Field(
        (), description="Names of Secrets with the registry's credentials"
    )
    world: ImageOf = Field(ImageOf(repository="cloudrc/world"), description="Of the world pod")
    cloud: ImageOf = Field(
        ImageOf(repository="cloudrc/cloud"), description="Of the cloud pod and of missions"
    )


class LinkContainer(Values):
    """The emulated network, in a container beside each end; it shapes what its pod sends."""

    mode: Literal["auto", "netem", "relay"] = Field(
        "auto",
        description="netem: the kernel's, needs NET_ADMIN; relay: a process, needs no privilege; "
        "auto: relay where the namespace enforces Pod Security baseline or restricted (or cannot "
        "be seen at install), elsewhere netem if the kernel has it, else relay",
    )
    profile: str | Profile | None = Field(
        None,
        description="A shipped profile's name, or one written here as in link/profiles/*.yaml; "
        "followed in flight, nothing restarts. null: the experiment's own link",
    )
    traces: Texts = Field(
        {},
        description="CSV files (name: text) that a profile written here, or the experiment's own "
        "link, names as trace or table",
        json_schema_extra={
            "propertyNames": {
                "pattern": r"^[-._a-zA-Z0-9]+$",
                # They lie beside these.
                "not": {"enum": ["profile.yaml", "change.json", "experiment.yaml"]},
            }
        },
    )
    resources: Resources = resources("20m", "40Mi", "1", "96Mi")


class Placement(Values):
    """Where a pod may run, and what is written on it."""

    node_selector: Texts = Field({}, description="Labels that the node must have")
    tolerations: tuple[dict[str, Any], ...] = Field((), description="Kubernetes' tolerations")
    affinity: dict[str, Any] = Field({}, description="Kubernetes' affinity")
    pod_annotations: Texts = Field({}, description="More annotations of the pod")
    pod_labels: Texts = Field(
        {},
        description="More labels of the pod; those of app.kubernetes.io are the chart's",
        json_schema_extra={"propertyNames": {"not": {"pattern": r"^app\.kubernetes\.io/"}}},
    )


class Epochs(Values):
    """The volume on which the highest number of a session outlives the pod."""

    existing_claim: Name = Field("", description="A claim to use in place of one made here")
    storage_class_name: str = Field("", description="Class of the volume; empty: the cluster's own")
    size: Quantity = Field("1Mi", description="Size of the volume [bytes]")


class WorldPod(Placement):
    """The robot's pod."""

    epochs: Epochs = Field(
        Epochs(), description="Where the highest number of a session outlives the pod"
    )
    resources: Resources = resources("60m", "96Mi", "1", "256Mi")
    recording_size_limit: Quantity = Field(
        "1Gi",
        description="Room for recordings: with one kept from before, nine tenths of it [bytes]",
    )


class BackgroundLoad(Values):
    """A container that burns CPU beside the controller: the loaded cloud of the paper."""

    enabled: bool = Field(False, description="Whether to add it")
    workers: Annotated[int, Field(ge=1, le=64)] = Field(
        1, description="Busy loops; each wants one core, the limit decides what they get [count]"
    )
    resources: Resources = resources("10m", "8Mi", "1", "16Mi")


class CloudPod(Placement):
    """The remote controller's pod."""

    resources: Resources = resources("60m", "64Mi", "1", "192Mi")
    recording_size_limit: Quantity = Field(
        "1Gi",
        description="Room for recordings: with one kept from before, nine tenths of it [bytes]",
    )
    background_load: BackgroundLoad = Field(BackgroundLoad(), description="CPU load beside it")


class Journal(Values):
    """The volume on which missions outlive the pod."""

    existing_claim: Name = Field("", description="A claim to use in place of one made here")
    storage_class_name: str = Field("", description="Class of the volume; empty: the cluster's own")
    size: Quantity = Field("64Mi", description="Size of the volume [bytes]")


class Service(Values):
    """The Service of the API."""

    type: Literal["ClusterIP", "NodePort", "LoadBalancer"] = Field("ClusterIP", description="Type")
    port: Annotated[int, Field(ge=1, le=65_535)] = Field(8080, description="TCP port")
    annotations: Texts = Field({}, description="Annotations of the Service")


class Tokens(Values):
    """Who may call the API."""

    existing_secret: Name = Field(
        "",
        description="A Secret with a token under `operator`, who commands, and if you like one "
        "under `reader`, who looks; empty: both are made once and kept",
    )


class Teleop(Values):
    """Missions, operator's hand and HTTP API, in the cloud pod."""

    resources: Resources = resources("30m", "72Mi", "1", "192Mi")
    journal: Journal = Field(Journal(), description="Where missions outlive the pod")
    tokens: Tokens = Field(Tokens(), description="Who may call the API")
    service: Service = Field(Service(), description="Where the API is reached")
    allow_from: tuple[Peer, ...] = Field(
        (), description="Who may call the API besides this release's missions; NetworkPolicy peers"
    )


class MissionJob(Values):
    """A mission that flies as a Job when the release is installed."""

    enabled: bool = Field(False, description="Whether to fly it")
    plan: str | Mission | None = Field(
        None, description="A shipped mission's name, or one written here; null: the experiment's"
    )
    queue: bool = Field(False, description="Wait where another mission flies; else be refused")
    active_deadline_seconds: Seconds = Field(
        600, description="The Job is ended after this time, waiting included [s]"
    )
    ttl_seconds_after_finished: Seconds = Field(
        86_400,
        description="The finished Job is kept for this long; an upgrade after it flies again [s]",
    )
    resources: Resources = resources("10m", "48Mi", "500m", "128Mi")


class Monitor(Values):
    """Objects of the Prometheus operator; made only where the cluster knows their kind."""

    enabled: bool = Field(False, description="Whether to make it")
    force: bool = Field(False, description="Also where the kind cannot be seen (helm template)")
    labels: Texts = Field({}, description="Labels by which your Prometheus finds it")


class PodMonitor(Monitor):
    """Scraping by the Prometheus operator."""

    interval: Annotated[str, Field(pattern=r"^[0-9]+(ms|s|m)$")] = Field(
        "5s", description="Between two scrapes [ms, s or m]"
    )


class Metrics(Values):
    """Who reads the metrics, and how they find them."""

    annotations: bool = Field(
        True, description="Write prometheus.io/scrape, port and path on the pods"
    )
    allow_from: tuple[Peer, ...] = Field(
        (), description="Who may scrape; NetworkPolicy peers; empty: nobody"
    )
    pod_monitor: PodMonitor = Field(PodMonitor(), description="Of the Prometheus operator")
    prometheus_rule: Monitor = Field(Monitor(), description="Alerts, of the Prometheus operator")


class NetworkPolicy(Values):
    """What the pods may send and receive: tunnel, names, API, metrics, and nothing else."""

    enabled: bool = Field(True, description="Whether to forbid everything else")
    dns: tuple[Peer, ...] = Field(
        (
            Peer(
                namespace_selector=Selector(
                    match_labels={"kubernetes.io/metadata.name": "kube-system"}
                )
            ),
        ),
        description="Where names are resolved (port 53); a node-local cache is an ipBlock",
    )


class Secret(Values):
    """The tunnel's pre-shared key."""

    existing_secret: Name = Field(
        "", description="A Secret with 32 bytes under `key`; empty: one is made once and kept"
    )


class ServiceAccount(Values):
    """The pods' accounts; they carry no token."""

    create: bool = Field(True, description="Whether to make one for each pod")
    name: Name = Field("", description="One to use for both where none is made; empty: default")
    annotations: Texts = Field({}, description="Annotations of those made here")


class ChartValues(Values):
    """Values of the chart cloudrc."""

    fullname_override: ObjectName = Field(
        "", description="Put in place of RELEASE-cloudrc in all names"
    )
    image: Image = Field(Image(), description="Which images the pods run")
    experiment: Experiment = Field(
        Experiment(),
        description="What to fly: the same mapping as in a file that 'cloudrc run' takes. "
        "What is not here is the paper's",
    )
    link: LinkContainer = Field(
        LinkContainer(), description="The emulated network between the pods"
    )
    world: WorldPod = Field(WorldPod(), description="The robot's pod")
    cloud: CloudPod = Field(CloudPod(), description="The remote controller's pod")
    teleop: Teleop = Field(Teleop(), description="Missions and API, in the cloud pod")
    mission: MissionJob = Field(
        MissionJob(), description="A mission that flies as a Job at install"
    )
    metrics: Metrics = Field(Metrics(), description="Who reads the metrics")
    network_policy: NetworkPolicy = Field(NetworkPolicy(), description="What the pods may exchange")
    secret: Secret = Field(Secret(), description="The tunnel's pre-shared key")
    service_account: ServiceAccount = Field(ServiceAccount(), description="The pods' accounts")
    termination_grace_period_seconds: Seconds = Field(
        10, description="Time for the pods to end; they need about two seconds [s]"
    )
    global_: dict[str, Any] | None = Field(
        None, alias="global", description="Helm's own, for charts that contain this one; not read"
    )
