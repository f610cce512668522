"""Define every value of the chart with its unit, default and description.

`docs.py` writes values.yaml, values.schema.json and the README's tables from these models. The
chart's keys are in camelCase; below `experiment` they are those of an experiment file.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

from cloudrc.config.schema import Experiment, Mission, Profile

Seconds = Annotated[int, Field(ge=0)]
ObjectName = Annotated[str, Field(pattern=r"^$|^[a-z]([-a-z0-9]*[a-z0-9])?$")]
Name = Annotated[str, Field(pattern=r"^$|^[a-z0-9]([-a-z0-9.]*[a-z0-9])?$")]
NotNegative = Annotated[float, Field(ge=0.0)]
Quantity = (
    Annotated[str, Field(pattern=r"^[0-9]+(\.[0-9]+)?(m|k|Ki|M|Mi|G|Gi|T|Ti)?$")] | NotNegative
)
Texts = dict[str, str]


class Values(BaseModel):
    """A part of the values; keys are in camelCase, and unknown keys are rejected."""

    model_config = ConfigDict(
        extra="forbid",
        alias_generator=to_camel,
        populate_by_name=True,
        use_attribute_docstrings=True,
    )


class Quantities(Values):
    """Amounts of CPU and memory."""

    cpu: Quantity | None = None
    """CPU [cores; 250m is a quarter of a core]"""
    memory: Quantity | None = None
    """Memory [bytes; 64Mi is 64 * 2^20]"""


class Resources(Values):
    """Requests and limits of one container; if all are equal, the pod's QoS class is Guaranteed."""

    requests: Quantities = Quantities()
    """Amounts that the scheduler reserves on the node"""
    limits: Quantities = Quantities()
    """Largest amounts; above them, CPU is throttled, or memory use ends the container"""


def resources(cpu: str, memory: str, cpu_limit: str, memory_limit: str) -> Any:
    """Declare the resources of a container with their defaults."""
    default = Resources(
        requests=Quantities(cpu=cpu, memory=memory),
        limits=Quantities(cpu=cpu_limit, memory=memory_limit),
    )
    return Field(default, description="Requests and limits of the container")


Peer = Annotated[
    dict[Literal["podSelector", "namespaceSelector", "ipBlock"], dict[str, Any]],
    Field(description="A peer of a NetworkPolicy; with both selectors, a pod must match both"),
]


class ImageOf(Values):
    """The image of one pod."""

    repository: str
    """Name of the image in the registry"""
    digest: Annotated[str, Field(pattern=r"^$|^sha256:[0-9a-f]{64}$")] = ""
    """Digest of the image, sha256:...; if it is set, the tag is ignored"""


class Image(Values):
    """The images of the pods."""

    registry: str = ""
    """Registry of both images, without a slash at its end"""
    tag: Annotated[str, Field(pattern=r"^$|^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$")] = ""
    """Tag of both images. Empty: the chart's appVersion"""
    pull_policy: Literal["Always", "IfNotPresent", "Never"] = "IfNotPresent"
    """When Kubernetes pulls the images"""
    pull_secrets: tuple[str, ...] = ()
    """Names of Secrets with credentials for the registry"""
    world: ImageOf = ImageOf(repository="cloudrc/world")
    """Image of the world pod"""
    cloud: ImageOf = ImageOf(repository="cloudrc/cloud")
    """Image of the cloud pod and of mission Jobs"""


class LinkContainer(Values):
    """The emulated network: a container in each pod that delays and drops what the pod sends."""

    mode: Literal["auto", "netem", "relay"] = "auto"
    """What emulates the network. netem: the kernel, needs NET_ADMIN. relay: a process without
    privileges. auto: relay if the namespace enforces Pod Security baseline or restricted, if that
    is unknown at install, or if the kernel has no netem; otherwise netem"""
    profile: str | Profile | None = None
    """Either the name of a shipped profile, or a mapping with the keys of a link profile. A change
    takes effect in flight, without a restart. null: the experiment's link"""
    traces: Texts = Field(
        {},
        json_schema_extra={
            "propertyNames": {
                "pattern": r"^[-._a-zA-Z0-9]+$",
                # Names of other files in the same folder.
                "not": {"enum": ["profile.yaml", "change.json", "experiment.yaml"]},
            }
        },
    )
    """CSV files, file name -> text, to which the keys `trace` and `table` of link.profile or of the
    experiment refer"""
    resources: Resources = resources("20m", "40Mi", "1", "96Mi")


class Placement(Values):
    """Node selection, annotations and labels of a pod."""

    node_selector: Texts = {}
    """Labels that the pod's node must have, as in Kubernetes"""
    tolerations: tuple[dict[str, Any], ...] = ()
    """Tolerations of the pod, as in Kubernetes"""
    affinity: dict[str, Any] = {}
    """Affinity of the pod, as in Kubernetes"""
    pod_annotations: Texts = {}
    """Additional annotations of the pod"""
    pod_labels: Texts = Field(
        {}, json_schema_extra={"propertyNames": {"not": {"pattern": r"^app\.kubernetes\.io/"}}}
    )
    """Additional labels of the pod; app.kubernetes.io/* is rejected"""


class WorldPod(Placement):
    """The pod of the robot."""

    epochs: Texts = {}
    """No longer used; accepted so that values of earlier versions stay valid"""
    resources: Resources = resources("60m", "96Mi", "1", "256Mi")
    recording_size_limit: Quantity = "1Gi"
    """Size limit of the volume for recordings [bytes]. After a restart, the volume also holds the
    recording from before. Recording ends when both together reach 90 % of the limit"""


class BackgroundLoad(Values):
    """A container that uses CPU time beside the controller, to test a cloud under load."""

    enabled: bool = False
    """Whether the pod has a further container, which only uses CPU time"""
    workers: Annotated[int, Field(ge=1, le=64)] = 1
    """Number of busy loops [count]; each loop uses up to one core, within the CPU limit"""
    resources: Resources = resources("10m", "8Mi", "1", "16Mi")


class CloudPod(Placement):
    """The pod of the remote controller."""

    resources: Resources = resources("60m", "64Mi", "1", "192Mi")
    recording_size_limit: Quantity = "1Gi"
    """Size limit of the volume for recordings [bytes]. After a restart, the volume also holds the
    recording from before. Recording ends when both together reach 90 % of the limit"""
    background_load: BackgroundLoad = BackgroundLoad()
    """Artificial CPU load in the cloud pod"""


class Journal(Values):
    """The volume that stores missions, so that they survive a replacement of the pod."""

    existing_claim: Name = ""
    """Name of an existing PersistentVolumeClaim. Empty: the chart creates a claim"""
    storage_class_name: str = ""
    """Storage class of the volume. Empty: the cluster's default"""
    size: Quantity = "64Mi"
    """Size of the volume [bytes]"""


class Service(Values):
    """The Service of teleop's HTTP API."""

    type: Literal["ClusterIP", "NodePort", "LoadBalancer"] = "ClusterIP"
    """Type of the Service"""
    port: Annotated[int, Field(ge=1, le=65_535)] = 8080
    """TCP port of the Service"""
    annotations: Texts = {}
    """Annotations of the Service"""


class Tokens(Values):
    """The tokens for teleop's HTTP API."""

    existing_secret: Name = ""
    """Name of an existing Secret. Its key `operator` has the token for commands, its optional key
    `reader` the token for reading only. Empty: the chart creates a Secret with both"""


class Teleop(Values):
    """Missions, the operator's commands and the HTTP API, in the cloud pod."""

    resources: Resources = resources("30m", "72Mi", "1", "192Mi")
    journal: Journal = Journal()
    """Volume that stores missions"""
    tokens: Tokens = Tokens()
    """Tokens for the API"""
    service: Service = Service()
    """Service of the API"""
    allow_from: tuple[Peer, ...] = ()
    """NetworkPolicy peers that may call the API; mission Jobs of this release may always call it"""


class Console(Values):
    """A page with the live scene, in the cloud pod, for 'cloudrc console --cluster'."""

    enabled: bool = False
    """Whether the pod has a further container, which serves the page; it uses the image of world.
    The page can be reached with kubectl port-forward alone, and who can reach it can steer"""
    resources: Resources = resources("50m", "160Mi", "1", "512Mi")
    """Requests and limits of the container"""


class MissionJob(Values):
    """A Job that flies a mission when the release is installed."""

    enabled: bool = False
    """Whether to fly the mission"""
    plan: str | Mission | None = None
    """Either the name of a shipped mission, or a mapping with the keys of a mission. null: the
    experiment's mission"""
    queue: bool = False
    """true: the mission waits until the present mission has ended. false: it is then rejected"""
    active_deadline_seconds: Seconds = 600
    """Time limit of the Job, including waiting [s]; after this time the Job fails"""
    ttl_seconds_after_finished: Seconds = 86_400
    """Time for which the finished Job is kept [s]. A later upgrade flies the mission again"""
    pod_annotations: Texts = {}
    """Additional annotations of the pods of missions and of helm test. In a mesh with sidecars a
    Job never ends; sidecar.istio.io/inject: "false" excludes Istio's sidecar"""
    resources: Resources = resources("10m", "48Mi", "500m", "128Mi")


class Monitor(Values):
    """An object for the Prometheus operator, created only if the cluster knows its kind."""

    enabled: bool = False
    """Whether the chart creates this object"""
    force: bool = False
    """Whether the chart creates the object even if its kind is unknown, as with helm template"""
    labels: Texts = {}
    """Labels by which your Prometheus selects the object"""


class PodMonitor(Monitor):
    """PodMonitor, with which the Prometheus operator scrapes the pods."""

    interval: Annotated[str, Field(pattern=r"^[0-9]+(ms|s|m)$")] = "5s"
    """Time between two scrapes, with its unit [ms, s or m]"""


class Metrics(Values):
    """Access to the metrics."""

    annotations: bool = True
    """Whether the pods have the annotations prometheus.io/scrape, port and path"""
    allow_from: tuple[Peer, ...] = ()
    """NetworkPolicy peers that may scrape the pods. Empty: only helm test"""
    pod_monitor: PodMonitor = PodMonitor()
    """PodMonitor of the Prometheus operator"""
    prometheus_rule: Monitor = Monitor()
    """Alerts for the Prometheus operator"""


class Dashboards(Values):
    """Dashboards for Grafana: ConfigMaps that the sidecar of its chart finds by a label."""

    enabled: bool = False
    """Whether the chart creates the ConfigMaps"""
    labels: Texts = {"grafana_dashboard": "1"}
    """Labels by which the sidecar selects the ConfigMaps"""
    annotations: Texts = {"grafana_folder": "cloudrc"}
    """Annotations of the ConfigMaps; the sidecar's option folderAnnotation names the one that
    selects the folder in Grafana"""


class NetworkPolicy(Values):
    """NetworkPolicies, which allow only the tunnel, DNS, the API and metrics."""

    enabled: bool = True
    """Whether the chart creates the NetworkPolicies"""
    dns: tuple[Peer, ...] = (
        {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "kube-system"}}},
    )
    """NetworkPolicy peers that resolve names (port 53); for a node-local cache, use an ipBlock"""


class Secret(Values):
    """The tunnel's pre-shared key."""

    existing_secret: Name = ""
    """Name of an existing Secret. Its key `key` has the text of the key file. Empty: the chart
    creates a Secret"""


class ServiceAccount(Values):
    """The pods' service accounts, which have no tokens."""

    create: bool = True
    """Whether the chart creates an account for each pod"""
    name: Name = ""
    """Service account of both pods if the chart creates none. Empty: the account `default`"""
    annotations: Texts = {}
    """Annotations of the accounts that the chart creates"""


class ChartValues(Values):
    """All values of the chart."""

    fullname_override: ObjectName = ""
    """First part of the names of all objects. Empty: RELEASE-cloudrc"""
    image: Image = Image()
    """Images of the pods"""
    experiment: Experiment = Experiment()
    """The experiment, with the keys of a file for 'cloudrc run'; missing keys: as in the paper"""
    link: LinkContainer = LinkContainer()
    """The emulated network between the pods"""
    world: WorldPod = WorldPod()
    """Pod of the robot"""
    cloud: CloudPod = CloudPod()
    """Pod of the remote controller"""
    teleop: Teleop = Teleop()
    """Missions and API, in the cloud pod"""
    console: Console = Console()
    """Page with the live scene, in the cloud pod"""
    mission: MissionJob = MissionJob()
    """Mission that a Job flies at install"""
    metrics: Metrics = Metrics()
    """Access to the metrics"""
    dashboards: Dashboards = Dashboards()
    """Dashboards for Grafana"""
    network_policy: NetworkPolicy = NetworkPolicy()
    """Limits on the pods' network traffic"""
    secret: Secret = Secret()
    """Pre-shared key of the tunnel"""
    service_account: ServiceAccount = ServiceAccount()
    """Service accounts of the pods"""
    ip_family_policy: Literal["SingleStack", "PreferDualStack", "RequireDualStack"] | None = (
        "PreferDualStack"
    )
    """Address families of the Services. The pods listen on IPv4 and IPv6; the tunnel needs IPv4.
    null: the cluster's default"""
    pod_security_context: dict[str, Any] | None = {
        "runAsNonRoot": True,
        "runAsUser": 10_001,
        "runAsGroup": 10_001,
        "fsGroup": 10_001,
        "seccompProfile": {"type": "RuntimeDefault"},
    }
    """Security context of all pods, as in Kubernetes. null: no security context, for OpenShift"""
    container_security_context: dict[str, Any] | None = {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    """Security context of all containers. The link container has its own if it uses netem. null: no
    security context"""
    termination_grace_period_seconds: Seconds = 10
    """Time that the pods get to end [s], after which they are killed; they need 2 s"""
    global_: dict[str, Any] | None = Field(None, alias="global")
    """Values that Helm passes to subcharts; this chart ignores them"""
