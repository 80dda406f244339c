"""API pages of records: shows the docstring that `@record` makes from the fields."""

from __future__ import annotations

import importlib
from typing import Any

import griffe


class RecordDocs(griffe.Extension):
    """Reads a record's docstring from the imported class: a field's meaning is in its declaration."""

    def on_class_instance(self, *, cls: griffe.Class, **_: Any) -> None:
        """Take over the docstring with its "Attributes" section."""
        if not any(str(decorator.value).startswith("record") for decorator in cls.decorators):
            return
        made = getattr(importlib.import_module(cls.module.path), cls.name, None)
        if made is not None and made.__doc__:
            cls.docstring = griffe.Docstring(made.__doc__, parent=cls, parser="numpy")
