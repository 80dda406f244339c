"""Several dumps of one mission, or several cameras of one dump: each calibrated by itself, and all together.

The joint matrix, of several cameras a matrix each, is `calib.calibrate` over all strips at once. They have
unknowns in common: the attitudes of strips that were taken at the same time, a camera's distortion, and the
coordinates of targets that several dumps list with one id, place and sigma. Ids get the name of their dump
before them, times count from the earliest dump's epoch, and everything is done in the order of time: the same
bits in whatever order dumps are named.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.hypotheses import MovedInput
from boresight.calib.reliability import examine
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Verdict, assess
from boresight.geometry.epoch import Epoch
from boresight.geometry.line_camera import LineSensor
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.diagnosis.unused_rows import Rows, rows_of_cameras, rows_together
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.run.several_dumps import NamedDump
from boresight.records.ledger import Entry
from boresight.records.record import Floats, record, scalar

__all__ = ["JointCalibration", "calibrate_jointly"]


@record(kw_only=True)
class JointCalibration:
    """One matrix from all dumps that could be calibrated."""

    estimate: InstallationEstimate = scalar("joint matrix with covariance and statistics")
    verdict: Verdict = scalar("whether the data contradict themselves")
    strips: tuple[StripSightings, ...] = scalar('of all dumps, ids "dump/strip", t_s since the first epoch')
    settings: CalibrationSettings = scalar("of the estimate")
    cameras: tuple[LineSensor, ...] = scalar("models of the estimate's remote-sensing cameras")
    sigma_installation_rad: Floats = scalar("1-sigma (3 C,) of their pre-launch matrices, axes of each")
    rows: tuple[Rows, ...] = scalar("how many rows of each table the estimate depends on")
    omissions: tuple[Entry, ...] = scalar("dumps without a result, observations that the fit rejects")


def calibrate_jointly(
    calibrated: Sequence[tuple[NamedDump, DumpCalibration]], failed: Sequence[Entry], settings: Settings
) -> JointCalibration:
    """One matrix from the strips of all dumps that have one of their own, in the order of time.

    `DataNotSufficientError` when there is none.
    """
    if not calibrated:
        reasons = "; ".join(f"{entry.subject.name}: {entry.text}" for entry in failed)
        raise DataNotSufficientError(f"none of {len(failed)} dumps could be calibrated: {reasons}")
    first, one = calibrated[0]
    epoch = first.dump.epoch
    of_cameras = {named.dump.camera: named.dump for named, _ in reversed(calibrated)}
    models = {named.dump.camera: found.settings for named, found in reversed(calibrated)}
    of_cameras = {name: of_cameras[name] for name in sorted(of_cameras)}
    several = tuple((name, models[name]) for name in of_cameras) if len(of_cameras) > 1 else ()
    model = replace(one.settings, of_cameras=several)
    target_names = _names_of_targets([named for named, _ in calibrated])
    strips = tuple(
        _renamed(strip, named, epoch, target_names) for named, found in calibrated for strip in found.strips
    )
    estimate = calibrate_strips(strips, {name: dump.R_cs0 for name, dump in of_cameras.items()}, model)
    if isinstance(estimate, NotObservable):
        raise DataNotSufficientError(f"all dumps together: {estimate.reason}")
    estimate = estimate.with_reference(first.dump.heads[0].name)
    sigma = np.concatenate([dump.sigma_installation_rad for dump in of_cameras.values()])
    pixel_rad = {name: dump.line_camera.pixel_rad for name, dump in of_cameras.items()}
    sighted = [
        _renamed(strip, named, epoch, target_names)
        for named, found in calibrated
        for strip in found.assessment.sighted
    ]
    reliability = examine(
        estimate,
        sighted,
        model,
        pixel_rad=pixel_rad if several else first.dump.line_camera.pixel_rad,
        star_camera=first.dump.star_camera,
        inputs=_joined_inputs(calibrated),
        target_files=first.dump.target_files,
        sigma_understated=settings.verdict.sigma_understated,
    )
    verdict = assess(
        estimate,
        strips,
        settings.verdict,
        sigma_installation_rad=sigma,
        reliability=reliability,
        target_files=first.dump.target_files,
    )
    cameras = tuple(dump.line_camera for dump in of_cameras.values())
    views: dict[Path, list[tuple[Rows, ...]]] = {}
    for named, found in calibrated:
        views.setdefault(named.dump.root, []).append(found.rows)
    return JointCalibration(
        estimate=estimate,
        verdict=verdict,
        strips=strips,
        settings=model,
        cameras=cameras,
        sigma_installation_rad=sigma,
        rows=rows_together([rows_of_cameras(own) for own in views.values()]),
        omissions=(*failed, *estimate.rejected),
    )


def _joined_inputs(calibrated: Sequence[tuple[NamedDump, DumpCalibration]]) -> list[MovedInput]:
    """What inputs of the same kind do in all dumps, strips with the names of their dumps."""
    joined: dict[tuple[str, str], MovedInput] = {}
    for named, found in calibrated:
        for one in found.assessment.inputs:
            before = joined.get((one.cause, one.item), replace(one, directions_i={}, turns_s={}))
            directions, turns = (
                {f"{named.name}/{strip_id}": change for strip_id, change in own.items()}
                for own in (one.directions_i, one.turns_s)
            )
            joined[one.cause, one.item] = replace(
                before,
                directions_i={**before.directions_i, **directions},
                turns_s={**before.turns_s, **turns},
            )
    return list(joined.values())


Place = tuple[str, bytes, bytes, str]


def _place(target: Any) -> Place:
    of = target.reference.name if target.reference else ""
    return target.target_id, target.p_e.tobytes(), target.sigma_m.tobytes(), of


def _names_of_targets(dumps: Iterable[NamedDump]) -> dict[Place, str]:
    """Names of targets by id, coordinates and sigma: after the first dump that lists them."""
    names: dict[Place, str] = {}
    for named in dumps:
        for target in named.dump.ground_targets.values():
            names.setdefault(_place(target), f"{named.name}/{target.target_id}")
    return names


def _renamed(
    strip: StripSightings, named: NamedDump, epoch: Epoch, target_names: dict[Place, str]
) -> StripSightings:
    """The strip as one of many dumps: ids with the dump's name, seconds since `epoch`."""
    later = strip.later(float(named.dump.epoch.tai_s - epoch.tai_s))
    own = {target.target_id: target_names[_place(target)] for target in named.dump.ground_targets.values()}
    targets = np.array([own.get(name, name) for name in strip.ground.target_id.tolist()], dtype=str)
    return replace(
        later,
        strip_id=f"{named.name}/{strip.strip_id}",
        camera=named.dump.camera,
        exposures=tuple(
            replace(one, exposure_id=f"{named.name}/{one.exposure_id}") for one in later.exposures
        ),
        ground=replace(later.ground, target_id=targets),
    )
