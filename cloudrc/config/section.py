# SPDX-License-Identifier: Apache-2.0

"""The base of all sections of files: strictly typed, described by the texts below the keys."""

from __future__ import annotations

import ast
import inspect
from dataclasses import is_dataclass
from functools import cache
from itertools import pairwise
from typing import Any

from pydantic import (
    BaseModel,
    ConfigDict,
    GetJsonSchemaHandler,
    SerializerFunctionWrapHandler,
    model_serializer,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema


@cache
def attribute_docstrings(owner: type) -> dict[str, str]:
    """Return the text below each attribute of a class: name -> text."""
    body = ast.parse(inspect.getsource(owner)).body[0]
    assert isinstance(body, ast.ClassDef)
    return {
        name.target.id: inspect.cleandoc(text.value.value)
        for name, text in pairwise(body.body)
        if isinstance(name, ast.AnnAssign)
        and isinstance(name.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
        and isinstance(text.value.value, str)
    }


class Described(BaseModel):
    """A model whose JSON schema has the texts below its attributes as descriptions.

    They are read when a schema is asked for. pydantic's use_attribute_docstrings would read the
    source of each class at its import, which takes a tenth of the time of a short command.
    """

    @classmethod
    def __get_pydantic_json_schema__(
        cls, core_schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        """Describe the keys, also those that the class has from a plain dataclass."""
        schema = handler(core_schema)
        texts: dict[str, str] = {}
        for base in reversed(cls.__mro__):
            if is_dataclass(base) or (issubclass(base, Described) and base.model_fields):
                texts |= attribute_docstrings(base)
        for key, part in handler.resolve_ref_schema(schema).get("properties", {}).items():
            if key in texts:
                part["description"] = texts[key]
        return schema


def leave_out_unset(*keys: str) -> Any:
    """Let a section leave out these keys where they have their default, so that its hash stays."""

    def write(self: BaseModel, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        written: dict[str, Any] = handler(self)
        fields = type(self).model_fields
        return {
            key: value
            for key, value in written.items()
            if key not in keys or getattr(self, key) != fields[key].default
        }

    return model_serializer(mode="wrap")(write)


class Section(Described):
    """A section of a file: immutable, strictly typed, without unknown keys or infinite numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)
