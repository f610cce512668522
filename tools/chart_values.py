"""Define every value of the chart, with its unit and default.

`chart_docs.py` writes values.yaml, values.schema.json and the README's tables from these models.
Keys are camelCase in the chart; below `experiment` they are those of an experiment file.
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
    """The image of one pod."""

    repository: str = Field(description="Name of the image in the registry")
    digest: Annotated[str, Field(pattern=r"^$|^sha256:[0-9a-f]{64}$")] = Field(
        "", description="Digest of the image, sha256:...; if set, the tag is ignored"
    )


class Image(Values):
    """The images of the pods."""

    registry: str = Field("", description="Registry of both images, without a slash at the end")
    tag: Annotated[str, Field(pattern=r"^$|^[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}$")] = Field(
        "", description="Tag of both images; empty: the chart's appVersion"
    )
    pull_policy: Literal["Always", "IfNotPresent", "Never"] = Field(
        "IfNotPresent", description="When Kubernetes pulls the images"
    )
    pull_secrets: tuple[str, ...] = Field(
        (), description="Names of Secrets with the registry's credentials"
    )
    world: ImageOf = Field(
        ImageOf(repository="cloudrc/world"), description="Image of the world pod"
    )
    cloud: ImageOf = Field(
        ImageOf(repository="cloudrc/cloud"), description="Image of the cloud pod and of missions"
    )


class LinkContainer(Values):
    """The emulated network: a container in each pod that shapes what the pod sends."""

    mode: Literal["auto", "netem", "relay"] = Field(
        "auto",
        description="What emulates the network. netem: the kernel, needs NET_ADMIN. relay: a "
        "process without privileges. auto: relay if the namespace enforces Pod Security baseline "
        "or restricted, or is unknown at install; otherwise netem if the kernel has it, else relay",
    )
    profile: str | Profile | None = Field(
        None,
        description="Either the name of a shipped profile, or a mapping with the keys of a file in "
        "link/profiles. A change takes effect in flight and restarts nothing. null: the "
        "experiment's link",
    )
    traces: Texts = Field(
        {},
        description="The CSV files that link.profile or the experiment's link names as trace or "
        "table: file name -> text of the file",
        json_schema_extra={
            "propertyNames": {
                "pattern": r"^[-._a-zA-Z0-9]+$",
                # Names of other files in the same folder.
                "not": {"enum": ["profile.yaml", "change.json", "experiment.yaml"]},
            }
        },
    )
    resources: Resources = resources("20m", "40Mi", "1", "96Mi")


class Placement(Values):
    """Nodes, annotations and labels of a pod."""

    node_selector: Texts = Field({}, description="Labels that the pod's node must have")
    tolerations: tuple[dict[str, Any], ...] = Field(
        (), description="Tolerations of the pod, as in Kubernetes"
    )
    affinity: dict[str, Any] = Field({}, description="Affinity of the pod, as in Kubernetes")
    pod_annotations: Texts = Field({}, description="Further annotations of the pod")
    pod_labels: Texts = Field(
        {},
        description="Further labels of the pod; app.kubernetes.io/* is refused",
        json_schema_extra={"propertyNames": {"not": {"pattern": r"^app\.kubernetes\.io/"}}},
    )


class WorldPod(Placement):
    """The pod of the robot."""

    epochs: Texts = Field({}, description="Ignored, because world no longer needs this volume")
    resources: Resources = resources("60m", "96Mi", "1", "256Mi")
    recording_size_limit: Quantity = Field(
        "1Gi",
        description="Size limit of the volume for recordings [bytes]; a recording ends when it and "
        "the one from before a restart together fill nine tenths of the volume",
    )


class BackgroundLoad(Values):
    """A container that burns CPU beside the controller, for a cloud under load."""

    enabled: bool = Field(
        False, description="Whether the pod has a container that only uses CPU time"
    )
    workers: Annotated[int, Field(ge=1, le=64)] = Field(
        1,
        description="Number of busy loops [count]; each uses up to one core, within the CPU limit",
    )
    resources: Resources = resources("10m", "8Mi", "1", "16Mi")


class CloudPod(Placement):
    """The pod of the remote controller."""

    resources: Resources = resources("60m", "64Mi", "1", "192Mi")
    recording_size_limit: Quantity = Field(
        "1Gi",
        description="Size limit of the volume for recordings [bytes]; a recording ends when it and "
        "the one from before a restart together fill nine tenths of the volume",
    )
    background_load: BackgroundLoad = Field(
        BackgroundLoad(), description="CPU load in the cloud pod"
    )


class Journal(Values):
    """The volume that keeps missions when the pod is replaced."""

    existing_claim: Name = Field(
        "",
        description="Name of an existing PersistentVolumeClaim; empty: the chart makes a claim",
    )
    storage_class_name: str = Field(
        "", description="Storage class of the volume; empty: the cluster's default"
    )
    size: Quantity = Field("64Mi", description="Size of the volume [bytes]")


class Service(Values):
    """The Service of the API."""

    type: Literal["ClusterIP", "NodePort", "LoadBalancer"] = Field(
        "ClusterIP", description="Type of the Service"
    )
    port: Annotated[int, Field(ge=1, le=65_535)] = Field(
        8080, description="TCP port of the Service"
    )
    annotations: Texts = Field({}, description="Annotations of the Service")


class Tokens(Values):
    """The tokens of the API."""

    existing_secret: Name = Field(
        "",
        description="Name of an existing Secret. Its key `operator` has the token to command, its "
        "optional key `reader` has the token to read. Empty: the chart makes a Secret with both",
    )


class Teleop(Values):
    """Missions, operator's commands and HTTP API, in the cloud pod."""

    resources: Resources = resources("30m", "72Mi", "1", "192Mi")
    journal: Journal = Field(Journal(), description="Volume that keeps missions")
    tokens: Tokens = Field(Tokens(), description="Tokens of the API")
    service: Service = Field(Service(), description="Service of the API")
    allow_from: tuple[Peer, ...] = Field(
        (),
        description="NetworkPolicy peers that may call the API; this release's missions always may",
    )


class MissionJob(Values):
    """A mission that flies as a Job when the release is installed."""

    enabled: bool = Field(False, description="Whether to fly the mission")
    plan: str | Mission | None = Field(
        None,
        description="Either the name of a shipped mission, or a mapping with the keys of a "
        "mission. null: the experiment's mission",
    )
    queue: bool = Field(
        False,
        description="true: the mission waits while another mission flies; false: it is refused",
    )
    active_deadline_seconds: Seconds = Field(
        600, description="Time limit of the Job, waiting included [s]; beyond it the Job fails"
    )
    ttl_seconds_after_finished: Seconds = Field(
        86_400,
        description="Time for which the finished Job is kept [s]; an upgrade after this time "
        "flies the mission again",
    )
    pod_annotations: Texts = Field(
        {},
        description="Further annotations of the pods of missions and of helm test. With the "
        "sidecar of a mesh, a Job never ends; to leave out Istio's sidecar: "
        'sidecar.istio.io/inject: "false"',
    )
    resources: Resources = resources("10m", "48Mi", "500m", "128Mi")


class Monitor(Values):
    """An object of the Prometheus operator, made only if the cluster knows its kind."""

    enabled: bool = Field(False, description="Whether the chart makes this object")
    force: bool = Field(
        False,
        description="Whether the chart makes the object even if the cluster does not know its kind "
        "(helm template)",
    )
    labels: Texts = Field({}, description="Labels by which your Prometheus selects it")


class PodMonitor(Monitor):
    """Scraping by the Prometheus operator."""

    interval: Annotated[str, Field(pattern=r"^[0-9]+(ms|s|m)$")] = Field(
        "5s", description="Time between two scrapes, with its unit [ms, s or m]"
    )


class Metrics(Values):
    """Access to the metrics."""

    annotations: bool = Field(
        True,
        description="Whether the pods have the annotations prometheus.io/scrape, port and path",
    )
    allow_from: tuple[Peer, ...] = Field(
        (), description="NetworkPolicy peers that may scrape; empty: only helm test"
    )
    pod_monitor: PodMonitor = Field(
        PodMonitor(), description="PodMonitor of the Prometheus operator"
    )
    prometheus_rule: Monitor = Field(Monitor(), description="Alerts for the Prometheus operator")


class NetworkPolicy(Values):
    """NetworkPolicies: the pods exchange tunnel, DNS, API and metrics, nothing else."""

    enabled: bool = Field(True, description="Whether the chart makes the NetworkPolicies")
    dns: tuple[Peer, ...] = Field(
        (
            Peer(
                namespace_selector=Selector(
                    match_labels={"kubernetes.io/metadata.name": "kube-system"}
                )
            ),
        ),
        description="NetworkPolicy peers that resolve names (port 53); for a node-local cache use "
        "an ipBlock",
    )


class Secret(Values):
    """The tunnel's pre-shared key."""

    existing_secret: Name = Field(
        "",
        description="Name of an existing Secret. Its key `key` has the key file. Empty: the chart "
        "makes a Secret",
    )


class ServiceAccount(Values):
    """The pods' service accounts, without tokens."""

    create: bool = Field(True, description="Whether the chart makes an account for each pod")
    name: Name = Field(
        "",
        description="Service account of both pods if the chart makes none; empty: the account "
        "`default`",
    )
    annotations: Texts = Field({}, description="Annotations of the accounts that the chart makes")


class ChartValues(Values):
    """All values of the chart."""

    fullname_override: ObjectName = Field(
        "", description="First part of the names of all objects; empty: RELEASE-cloudrc"
    )
    image: Image = Field(Image(), description="Images of the pods")
    experiment: Experiment = Field(
        Experiment(),
        description="The experiment, with the keys of a file for 'cloudrc run'. Missing keys have "
        "the values of the paper",
    )
    link: LinkContainer = Field(
        LinkContainer(), description="The emulated network between the pods"
    )
    world: WorldPod = Field(WorldPod(), description="Pod of the robot")
    cloud: CloudPod = Field(CloudPod(), description="Pod of the remote controller")
    teleop: Teleop = Field(Teleop(), description="Missions and API, in the cloud pod")
    mission: MissionJob = Field(MissionJob(), description="Mission that flies as a Job at install")
    metrics: Metrics = Field(Metrics(), description="Access to the metrics")
    network_policy: NetworkPolicy = Field(
        NetworkPolicy(), description="Limits on the pods' traffic"
    )
    secret: Secret = Field(Secret(), description="Pre-shared key of the tunnel")
    service_account: ServiceAccount = Field(
        ServiceAccount(), description="Service accounts of the pods"
    )
    ip_family_policy: Literal["SingleStack", "PreferDualStack", "RequireDualStack"] | None = Field(
        "PreferDualStack",
        description="Address families of the Services. The pods listen on both; the tunnel needs "
        "IPv4. null: the cluster's default",
    )
    pod_security_context: dict[str, Any] | None = Field(
        {
            "runAsNonRoot": True,
            "runAsUser": 10_001,
            "runAsGroup": 10_001,
            "fsGroup": 10_001,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        description="Security context of all pods, as in Kubernetes. null: no security context, "
        "for OpenShift, which gives each namespace its own user ids",
    )
    container_security_context: dict[str, Any] | None = Field(
        {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        description="Security context of all containers, except the link container with netem, "
        "which has its own. null: no security context",
    )
    termination_grace_period_seconds: Seconds = Field(
        10, description="Time in which the pods must end [s], else they are killed; they need 2 s"
    )
    global_: dict[str, Any] | None = Field(
        None,
        alias="global",
        description="Values that Helm passes to subcharts; this chart ignores them",
    )
