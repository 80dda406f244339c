"""The units of work that can be done anywhere: one exposure, one strip. What is on disk is not made again.

Kept apart from the rest so that a worker process loads only what it needs.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2

from boresight.pipeline.errors import Omission
from boresight.pipeline.stages.exposure import StarTask, sight_exposure, stars_table
from boresight.pipeline.stages.strip import StripTask, match_targets, nothing_placed, placings_table
from boresight.pipeline.work.unit_store import UnitStore, digest, program

__all__ = ["Made", "StarUnit", "StripUnit"]

# What numerical code may raise on data that nobody thought of. One image's misfortune is not the run's; it is
# counted and its text points to the fault.
UNFORESEEN = (ValueError, ArithmeticError, cv2.error)

# What a unit rests on: it is made again when the source of one of these has changed.
STAR_CODE = ("boresight.geometry", "boresight.star_id", "boresight.pipeline.stages")
STRIP_CODE = ("boresight.geometry", "boresight.gct_match", "boresight.pipeline.stages")


@dataclass(frozen=True, slots=True)
class Made:
    """A unit that is on disk now. `redone` tells whether it had to be made in this run."""

    name: str
    key: str
    redone: bool


@dataclass(frozen=True, slots=True)
class StarUnit:
    """Makes one exposure's unit unless the store has it."""

    store: UnitStore

    def __call__(self, task: StarTask) -> Made:
        name, key = (
            task.exposure.exposure_id,
            digest("stars", program(*STAR_CODE), task),
        )
        if self.store.read("exposures", name, key) is not None:
            return Made(name, key, False)
        try:
            outcome = sight_exposure(task)
        except UNFORESEEN as error:
            outcome = Omission("exposure", name, task.exposure.file, _told(error))
        self.store.write("exposures", name, key, *stars_table(task, outcome))
        return Made(name, key, True)


@dataclass(frozen=True, slots=True)
class StripUnit:
    """Makes one strip's unit of one matching unless the store has it."""

    store: UnitStore
    stage: str

    def __call__(self, task: StripTask) -> Made:
        name, key = (
            task.strip.strip_id,
            digest(
                "places",
                program(*STRIP_CODE),
                task,
            ),
        )
        if self.store.read(self.stage, name, key) is not None:
            return Made(name, key, False)
        try:
            placings = match_targets(task)
        except UNFORESEEN as error:
            placings = nothing_placed(task.strip, Omission("strip", name, "", _told(error)))
        self.store.write(self.stage, name, key, *placings_table(placings))
        return Made(name, key, True)


def _told(error: Exception) -> str:
    return f"could not be worked on, please report this: {type(error).__name__}: {str(error)[:300]}"
