"""Values of the chart that Kubernetes defines: amounts of resources, selectors, peers."""

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
    """A part of the values: closed, camelCase."""

    model_config = ConfigDict(extra="forbid", alias_generator=to_camel, populate_by_name=True)


class Quantities(Values):
    """Amounts of what a container uses."""

    cpu: Quantity | None = Field(None, description="Processor time [cores; 250m is a quarter]")
    memory: Quantity | None = Field(None, description="Memory [bytes; 64Mi is 64 * 2^20]")


class Resources(Values):
    """Requests and limits of one container; equal ones everywhere make the pod Guaranteed."""

    requests: Quantities = Field(Quantities(), description="What the scheduler sets aside")
    limits: Quantities = Field(
        Quantities(), description="What it cannot exceed; CPU above it is throttled, not refused"
    )


def resources(cpu: str, memory: str, cpu_limit: str, memory_limit: str) -> Any:
    """Declare a container's resources with their defaults."""
    default = Resources(
        requests=Quantities(cpu=cpu, memory=memory),
        limits=Quantities(cpu=cpu_limit, memory=memory_limit),
    )
    return Field(default, description="Requests and limits of the container")


class Expression(Values):
    """One condition of a selector."""

    key: str = Field(description="Label")
    operator: Literal["In", "NotIn", "Exists", "DoesNotExist"] = Field(description="Relation")
    values: tuple[str, ...] | None = Field(None, description="Values for In and NotIn")


class Selector(Values):
    """Kubernetes' label selector."""

    match_labels: Texts | None = Field(None, description="Labels with their values")
    match_expressions: tuple[Expression, ...] | None = Field(None, description="Conditions")


class IpBlock(Values):
    """A range of addresses."""

    cidr: str = Field(description="Range, such as 10.0.0.0/8")
    except_: tuple[str, ...] | None = Field(None, alias="except", description="Ranges left out")


class Peer(Values):
    """Who may connect, as in a NetworkPolicy; both selectors together mean both at once."""

    pod_selector: Selector | None = Field(None, description="Pods of this namespace, or those of")
    namespace_selector: Selector | None = Field(None, description="these namespaces")
    ip_block: IpBlock | None = Field(None, description="Addresses, in place of selectors")
