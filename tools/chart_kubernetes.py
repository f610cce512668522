"""Define the values that Kubernetes specifies: resources, selectors, NetworkPolicy peers."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel

NotNegative = Annotated[float, Field(ge=0.0)]
Quantity = (
    Annotated[str, Field(pattern=r"^[0-9]+(\.[0-9]+)?(m|k|Ki|M|Mi|G|Gi|T|Ti)?$")] | NotNegative
)
Texts = dict[str, str]


class Values(BaseModel):
    """A part of the values: camelCase keys, no unknown ones."""

    model_config = ConfigDict(extra="forbid", alias_generator=to_camel, populate_by_name=True)


class Quantities(Values):
    """Amounts of CPU and memory."""

    cpu: Quantity | None = Field(None, description="CPU [cores; 250m is a quarter of one]")
    memory: Quantity | None = Field(None, description="Memory [bytes; 64Mi is 64 * 2^20]")


class Resources(Values):
    """Requests and limits of one container; if they are equal everywhere, the pod is Guaranteed."""

    requests: Quantities = Field(Quantities(), description="Amounts that the scheduler reserves")
    limits: Quantities = Field(
        Quantities(),
        description="Largest amounts; above them CPU is throttled, and memory ends the container",
    )


def resources(cpu: str, memory: str, cpu_limit: str, memory_limit: str) -> Any:
    """Declare the resources of a container with their defaults."""
    default = Resources(
        requests=Quantities(cpu=cpu, memory=memory),
        limits=Quantities(cpu=cpu_limit, memory=memory_limit),
    )
    return Field(default, description="Requests and limits of the container")


class Expression(Values):
    """One condition of a selector."""

    key: str = Field(description="Label")
    operator: Literal["In", "NotIn", "Exists", "DoesNotExist"] = Field(
        description="Relation of the label to the values"
    )
    values: tuple[str, ...] | None = Field(None, description="Values for In and NotIn")


class Selector(Values):
    """A label selector of Kubernetes."""

    match_labels: Texts | None = Field(None, description="Labels and their values")
    match_expressions: tuple[Expression, ...] | None = Field(None, description="Conditions")


class IpBlock(Values):
    """A range of addresses."""

    cidr: str = Field(description="Address range, such as 10.0.0.0/8")
    except_: tuple[str, ...] | None = Field(None, alias="except", description="Excluded ranges")


class Peer(Values):
    """A peer of a NetworkPolicy; with both selectors, a pod must match both."""

    pod_selector: Selector | None = Field(
        None, description="Selects pods: of this namespace, or of the selected ones"
    )
    namespace_selector: Selector | None = Field(None, description="Selects namespaces")
    ip_block: IpBlock | None = Field(None, description="Address range, in place of selectors")
