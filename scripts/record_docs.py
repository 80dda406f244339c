"""API pages of records: the docstring that `@record` makes from the fields takes the place of the written one."""

from __future__ import annotations

import importlib
from typing import Any

import griffe


class RecordDocs(griffe.Extension):
    """Reads the docstring of a record from the imported class, since a field's meaning stands in its declaration."""

    def on_class_instance(self, *, cls: griffe.Class, **_: Any) -> None:
        """Take over the docstring with its "Attributes" section."""
        if not any(str(decorator.value).startswith("record") for decorator in cls.decorators):
            return
        made = getattr(importlib.import_module(cls.module.path), cls.name, None)
        if made is not None and made.__doc__:
            cls.docstring = griffe.Docstring(made.__doc__, parent=cls, parser="numpy")
