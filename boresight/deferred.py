"""Modules that libraries import and that this program does not use, loaded when something in them is used.

Only the command line does this, for its own process.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder
from types import ModuleType
from typing import Any

__all__ = ["defer"]

OF_IMPORT = ("__path__", "__file__", "__cached__")  # asked for by the import itself


def defer(*names: str) -> None:
    """Have imports of these modules, of which none is loaded yet, make empty ones that load themselves when
    one of their attributes is asked for.
    """
    sys.meta_path.insert(0, _Deferring(set(names)))


class _Deferred(ModuleType):
    def __getattr__(self, name: str) -> Any:
        if name in OF_IMPORT:
            raise AttributeError(name)
        own: ModuleSpec = self.__spec__.loader_state  # type: ignore[union-attr]
        assert own.loader is not None
        self.__class__, self.__spec__, self.__loader__ = ModuleType, own, own.loader  # type: ignore[assignment]
        own.loader.exec_module(self)
        return getattr(self, name)


class _Deferring(MetaPathFinder, Loader):
    def __init__(self, names: set[str]) -> None:
        self.names = names

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        own = PathFinder.find_spec(name, path) if name in self.names else None
        if own is None or own.loader is None:
            return None
        spec = ModuleSpec(name, self, origin=own.origin, loader_state=own)
        spec.submodule_search_locations, spec.has_location = own.submodule_search_locations, own.has_location
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Deferred(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing: the module is executed when its first attribute is asked for."""
