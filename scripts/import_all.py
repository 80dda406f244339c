"""Imports every module of the package once, so that Python keeps the bytecode of what a command can load.

`make install` runs it: pip compiles nothing there, since most of what it installs is never loaded, and where
PYTHONDONTWRITEBYTECODE is set, as container images do, no later process would keep anything.
"""

from __future__ import annotations

import importlib
import pkgutil

import boresight

for module in pkgutil.walk_packages(boresight.__path__, "boresight."):
    importlib.import_module(module.name)
