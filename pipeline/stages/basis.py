"""What a calibration rests on while strips are matched again and again."""

from __future__ import annotations

from dataclasses import dataclass

from boresight.calib.settings import CalibrationSettings
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.cached import StageRunner
from boresight.pipeline.stages.head import HeadSightings

__all__ = ["Basis"]


@dataclass(frozen=True)
class Basis:
    """What every round and every test of a calibration rests on, the same for all of them."""

    dump: Dump
    heads: tuple[HeadSightings, ...]  # its star cameras with their attitudes; the first defines frame s
    settings: Settings
    errors: CalibrationSettings  # of the estimate, with the errors that the dump states
    runner: StageRunner

    @property
    def reference(self) -> str:
        """Name of the star camera that defines frame s."""
        return self.heads[0].head.name
