"""What the hypotheses about a dump's inputs say of its strips, and which convention or exchange explains that
strips show nothing where they should.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate
from boresight.calib.finding import Finding
from boresight.calib.moved_input import MovedInput
from boresight.calib.reliability import Reliability, examine
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.line_camera import LineCamera, LineSensor
from boresight.geometry.record import Floats
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.diagnosis.missing import misses
from boresight.pipeline.diagnosis.moved_inputs import moved_inputs
from boresight.pipeline.diagnosis.own_motion import against_own_motion
from boresight.pipeline.diagnosis.readings import best_reading, readings_of_dump, reversed_strips
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import calibration_settings
from boresight.pipeline.stages.basis import Basis
from boresight.pipeline.stages.cached import StageRunner
from boresight.pipeline.stages.coverage import stated_mountings
from boresight.pipeline.stages.head import sight_head
from boresight.pipeline.stages.sky_side import SkySide, find_in_sky_strips, name_in_sky_strips
from boresight.pipeline.stages.strip import StripTask, pushbroom_of
from boresight.pipeline.stages.strip_tasks import strip_tasks

__all__ = ["cause_of_no_result", "examined", "wrong_convention"]


def cause_of_no_result(
    basis: Basis, sky: SkySide, strips: Sequence[StripSightings], tasks: Sequence[StripTask]
) -> Finding | None:
    """Why strips do not determine a matrix: a convention, or what the hypotheses tell of all observations
    together, none rejected.
    """
    if of_attitudes := against_own_motion(basis.heads):
        return of_attitudes[0]
    if reversed_strip := next(reversed_strips(basis.dump, sky), None):
        return reversed_strip
    if finding := wrong_convention(basis):
        return finding
    plain = replace(basis.errors, robust=False)
    together = calibrate_strips(strips, basis.dump.R_cs0, plain) if strips else None
    if not isinstance(together, InstallationEstimate):
        return None
    found = examined(basis, together, strips, plain, moved_inputs(basis.dump, strips, tasks))
    return next(iter(found.findings), None)


def wrong_convention(basis: Basis) -> Finding | None:
    """The reading of the dump by which most strips see their stars or targets, where as stated few do."""
    dump, agreeing = basis.dump, partial(_agreeing_strips, basis)
    strips, stated = len(dump.strips) + len(dump.sky_strips), agreeing(dump)
    if 2 * stated > strips:
        return None
    best = best_reading(dump, readings_of_dump(dump), agreeing, strips // 2 + 1, strips)
    if not best:
        return None
    reading, count = best
    see = f"{count} of {strips} strips see their stars or targets, as stated {stated}"
    return reading.finding(f"{reading.changed} {see}", refutes=True)


def examined(
    basis: Basis,
    estimate: InstallationEstimate,
    strips: Sequence[StripSightings],
    errors: CalibrationSettings,
    inputs: Sequence[MovedInput],
) -> Reliability:
    """The hypotheses about the inputs of a dump, held against an estimate that was made with `errors`."""
    return examine(
        estimate,
        strips,
        errors,
        pixel_rad=basis.dump.line_camera.pixel_rad,
        star_camera=basis.dump.star_camera,
        inputs=inputs,
        pivots=_pivots(basis.dump.line_camera),
        target_files=basis.dump.target_files,
        limits=basis.settings.verdict.of_reliability,
    )


def _pivots(camera: LineSensor) -> dict[tuple[str, int], float]:
    """Samples about which CCDs are rotated; none where the camera states look angles."""
    ccds = camera.ccds if isinstance(camera, LineCamera) else ()
    return {("", n): ccd.principal_sample for n, ccd in enumerate(ccds)}


def _agreeing_strips(basis: Basis, dump: Dump) -> int:
    """Strips of a dump with another convention than that of `basis` that see their stars or targets by the
    pre-launch matrices.
    """
    runner, settings = StageRunner(None, InOrder()), basis.settings
    fit = calibration_settings(settings, dump.errors, dump.line_camera).attitudes
    heads = [
        sight_head(dump, head, settings, fit, runner)
        if isinstance(head.source, SolvedAttitudes)
        else replace(before, head=head)
        for head, before in zip(dump.heads, basis.heads)
    ]
    start = dump.R_cs0, dump.sigma_installation_rad
    tasks, _ = strip_tasks(dump, heads, *start, stated_mountings(heads), settings, with_slips=False)
    named = name_in_sky_strips(dump, find_in_sky_strips(dump, heads, settings, runner), *start, known=False)
    return sum(_sees_its_targets(task, dump) for task in tasks) + sum(len(one.rows) > 0 for one in named)


def _sees_its_targets(task: StripTask, dump: Dump) -> bool:
    """Whether a strip shows a target, or its measured points lie where the pre-launch matrix allows."""
    points = task.points
    if not len(points.ccd):
        outside = misses(task, dump.targets)[0] if dump.targets else np.full((1, 2), np.nan)
        return bool((np.hypot(*outside.T) == 0.0).any())
    limit_px = task.settings.sigmas * float(task.sigma_installation_rad.max()) / task.camera.pixel_rad
    p_e = np.array([target.p_e for target in points.targets])
    near: Floats = np.zeros(len(points.ccd))
    for ccd in np.unique(points.ccd).tolist():
        here = points.ccd == ccd
        sample, line = pushbroom_of(task).pixels_from_ground(ccd, p_e[here])
        off_px = np.hypot(sample - points.xy_px[here, 0], line - points.xy_px[here, 1])
        near[here] = np.nan_to_num(off_px, nan=np.inf) < limit_px
    return bool(near.mean() > 0.5)
