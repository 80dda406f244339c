"""From dumps or finished results to the interior orientation of the remote-sensing camera."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from boresight.calib.estimate import NotObservable
from boresight.calib.settings import CalibrationSettings
from boresight.features.interior.interior_estimate import InteriorEstimate, calibrate_interior
from boresight.features.interior.interior_parameters import InteriorPriors
from boresight.geometry.line_camera import LineCamera
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.calibration.joint import calibrate_jointly
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.results.ownership import MARKER, dump_folder_of
from boresight.pipeline.run.cached import Progress
from boresight.pipeline.run.executor import Executor
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.several_dumps import dump_names, open_dumps
from boresight.records.record import array, record, scalar

__all__ = ["InteriorCalibration", "calibrate_remote_camera"]


@record(kw_only=True)
class InteriorCalibration:
    """The interior orientation, and what it was made from."""

    found: InteriorEstimate = scalar("parameters, covariance, camera")
    strips: tuple[StripSightings, ...] = array("S", "strips, those of the sky included")
    dump: Dump = scalar("the first dump")


def calibrate_remote_camera(
    sources: Sequence[Path],
    settings: Settings,
    priors: InteriorPriors,
    executor: Executor,
    progress: Progress,
) -> InteriorCalibration:
    """Interior orientation from the strips of dumps, or of the dumps that results were made from; what is
    finished in the folder of a result is not computed again.

    `RawDataError` for a camera of look tables, `DataNotSufficientError` where no matrix can be estimated.
    """
    results = {n: path for n, path in enumerate(sources) if (path / MARKER).is_file()}
    roots = [dump_folder_of(path) if n in results else path for n, path in enumerate(sources)]
    if len(roots) == 1:
        dump = open_dump(roots[0].resolve())
        store = store_of(results[0].resolve()) if results else None
        one = calibrate_dump(dump, settings, store, executor, progress)
        return _interior(dump, one.strips, one.settings, priors)
    dumps = open_dumps(roots, settings)
    names = dict(zip(dump_names([root.resolve() for root in roots]), range(len(roots))))
    calibrated = []
    for named in dumps:
        place = names[named.name]
        store = store_of(results[place].resolve()) if place in results else None
        calibrated.append((named, calibrate_dump(named.dump, settings, store, executor, progress)))
    joint = calibrate_jointly(calibrated, (), settings)
    return _interior(dumps[0].dump, joint.strips, joint.settings, priors)


def _interior(
    dump: Dump, strips: tuple[StripSightings, ...], settings: CalibrationSettings, priors: InteriorPriors
) -> InteriorCalibration:
    if not isinstance(dump.line_camera, LineCamera):
        path = dump.root / "dump.toml"
        raise RawDataError(str(path), "remote_camera", "look tables", "a camera described by its hardware")
    found = calibrate_interior(strips, dump.R_cs0, dump.line_camera, settings, priors)
    if isinstance(found, NotObservable):
        raise DataNotSufficientError(found.reason)
    return InteriorCalibration(found=found, strips=strips, dump=dump)
