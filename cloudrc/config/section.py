"""The base of all sections of files: strictly typed, described by the texts below the keys."""

from __future__ import annotations

import ast
import inspect
from dataclasses import is_dataclass
from itertools import pairwise
from typing import Any

from pydantic import BaseModel, ConfigDict


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


class Section(BaseModel):
    """A section of a file: immutable, strictly typed, without unknown keys or infinite numbers."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Take the texts of keys that the class has from a plain class."""
        texts: dict[str, str] = {}
        for base in cls.__mro__:
            if is_dataclass(base):
                texts = attribute_docstrings(base) | texts
        for key, info in cls.model_fields.items():
            info.description = info.description or texts.get(key)
        if texts:
            cls.model_rebuild(force=True)
