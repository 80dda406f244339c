"""The installation matrix from directions that others measured."""

from boresight.pipeline.console.feature import Feature

__all__ = ["FEATURE"]

# What `boresight.features.table` finds of this feature: it has no command, `boresight.vectors` calls it.
FEATURE = Feature("features.vectors", commands=())
