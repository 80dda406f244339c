"""The features of the program, one line each. A line and the folder of its name can be taken out together."""

from __future__ import annotations

from importlib import import_module

from boresight.pipeline.console.feature import AfterJoint, Feature
from boresight.pipeline.console.program import function_at

__all__ = ["after_joint", "features"]

NAMES = (
    "sky_images",
    "targets",
    "planning",
    "operators",
    "exports",
    "geolocate",
    "heads",
    "interior",
    "drift",
    "simulation",
    "paper",
)


def features() -> tuple[Feature, ...]:
    """All features, in the order of the program's help."""
    return tuple(import_module(f"boresight.features.{name}").FEATURE for name in NAMES)


def after_joint() -> tuple[AfterJoint, ...]:
    """What features do at the end of a calibration of several dumps."""
    return tuple(function_at(one.after_joint) for one in features() if one.after_joint)
