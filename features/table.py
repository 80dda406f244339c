"""The features of the program, one line each. A line and the folder of its name can be taken out together."""

from __future__ import annotations

from importlib import import_module

from boresight.pipeline.console.feature import Feature

__all__ = ["features"]

# Folders of `features/`, in the order in which --help lists their commands.
NAMES = (
    "sky_images",
    "targets",
    "planning",
    "operators",
    "exports",
    "geolocate",
    "vectors",
    "heads",
    "interior",
    "mission",
    "simulation",
    "paper",
)


def features() -> tuple[Feature, ...]:
    """All features, in the order of the program's help."""
    return tuple(import_module(f"boresight.features.{name}").FEATURE for name in NAMES)
