"""One star camera of a dump: from what it delivers to attitudes of exposures.

    images, or centroids -> identified stars -> attitudes
    attitudes that the head has solved -> aberration put right

Attitudes that a head has solved become exposures without stars, so that all levels go the same way from here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.finding import Finding
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.attitude import AttitudeTrack, NominalMotion
from boresight.geometry.attitude_estimate import fit_exposures
from boresight.geometry.attitude_smoother import smoothed_track
from boresight.geometry.orbit import Orbit, OrbitGapError
from boresight.geometry.sightings import (
    ExposureAttitudes,
    StarSightings,
    exposure_without_stars,
    solved_attitudes,
)
from boresight.geometry.terrain import Surface
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import Head, SolvedAttitudes
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.stages.coverage import rows_of_heads
from boresight.pipeline.stages.exposure import sight_exposure, star_tasks
from boresight.records.ledger import Entry, Reason
from boresight.records.record import Bools, Floats, array, record, scalar

__all__ = ["Basis", "HeadSightings", "around_strips", "before_calibration", "covered_instants", "sight_head"]

UNKNOWN_ALIGNMENT_RAD = 0.1  # 1-sigma of alignments that the rows themselves tell better


@record(kw_only=True)
class HeadSightings:
    """Exposures of one head with their attitudes."""

    head: Head = scalar("the head")
    stars: tuple[StarSightings, ...] = array("K", "in order of time; none where the head solved attitudes")
    attitudes: ExposureAttitudes = scalar("attitudes of the same exposures")
    omissions: tuple[Entry, ...] = scalar("what cannot be used, with the reasons")


def sight_head(dump: Dump, head: Head, settings: Settings, runner: StageRunner) -> HeadSightings:
    """Exposures of a head around the strips of its dump, and their attitudes."""
    if isinstance(head.source, SolvedAttitudes):
        return _solved(dump, head, head.source, settings.run.exposure_margin_s)
    folder = "exposures" if head is dump.heads[0] else f"exposures-{head.name}"
    tasks, uncovered = star_tasks(dump, head.source, settings.stars)
    outcomes = runner.run(sight_exposure, tasks, folder=folder)
    stars = [one for one in outcomes if isinstance(one, StarSightings)]
    stars.sort(key=lambda one: (one.t_s, one.exposure_id))  # the order in which sums are made
    failed = [one for one in outcomes if isinstance(one, Entry)]
    fit = calibration_settings(settings, dump.errors, dump.line_camera).attitudes
    return HeadSightings(
        head=head, stars=tuple(stars), attitudes=fit_exposures(stars, fit), omissions=(*uncovered, *failed)
    )


def around_strips(dump: Dump, t_s: Floats, margin_s: float) -> Bools:
    """Which instants (K,) lie within a strip of the dump or at most `margin_s` outside."""
    near = np.zeros(len(t_s), dtype=bool)
    for strip in (*dump.strips, *dump.sky_strips):
        first, last = dump.span_s(strip)
        near |= (t_s >= first - margin_s) & (t_s <= last + margin_s)
    return near


def _solved(dump: Dump, head: Head, source: SolvedAttitudes, margin_s: float) -> HeadSightings:
    rows, omissions = source.rows, []
    if rows.n_invalid:
        reason = f"{rows.n_invalid} of {len(rows.t_s) + rows.n_invalid} attitudes are marked invalid"
        omissions.append(Entry(head.subject, Reason.MARKED_INVALID, reason))
    near = around_strips(dump, rows.t_s, margin_s)
    covered = near & covered_instants(dump.orbit, rows.t_s, near)
    if lost := int((near & ~covered).sum()):
        reason = f"the orbit has no states for {lost} of its {int(near.sum())} attitudes around strips"
        omissions.append(Entry(head.subject, Reason.NOT_COVERED, reason))
    at = np.flatnonzero(covered)
    t_s = rows.t_s[at]
    R_si = source.with_all_aberration(at, dump.epoch, dump.orbit)
    names = [f"{head.name}-{k + 1:06d}" for k in at.tolist()]
    white = np.tile(head.noise.white_covariance_s, (len(at), 1, 1))
    return HeadSightings(
        head=head,
        stars=tuple(map(exposure_without_stars, names, t_s.tolist())),
        attitudes=solved_attitudes(R_si, white if rows.covariance_s is None else rows.covariance_s[at]),
        omissions=tuple(omissions),
    )


def before_calibration(
    dump: Dump, t_s: Floats, mountings: Mapping[str, Rotation], carrier: str, nominal: NominalMotion
) -> AttitudeTrack:
    """Attitudes at a carrier's (K,), frame s, by all heads and the gyro; only rows tell their alignments."""
    rows = rows_of_heads(dump, t_s, mountings, carrier, nominal)
    gyro = dump.heads[0].gyro_around(t_s, nominal)
    return smoothed_track(rows, nominal, UNKNOWN_ALIGNMENT_RAD, gyro)


def covered_instants(orbit: Orbit, t_s: Floats, wanted: Bools) -> Bools:
    """Which of the wanted instants (K,) the orbit has states for."""
    try:
        orbit.positions_i(t_s[wanted])
        return wanted
    except OrbitGapError:
        pass
    covered = np.zeros(len(t_s), dtype=bool)
    for k in np.flatnonzero(wanted):
        try:
            orbit.positions_i(t_s[k : k + 1])
        except OrbitGapError:
            continue
        covered[k] = True
    return covered


@dataclass(frozen=True)
class Basis:
    """What every round and every test of a calibration rests on, the same for all of them."""

    dump: Dump
    heads: tuple[HeadSightings, ...]  # its star cameras with their attitudes; the first defines frame s
    settings: Settings
    errors: CalibrationSettings  # of the estimate, with the errors that the dump states
    runner: StageRunner
    surface: Surface  # of the Earth
    of_attitudes: tuple[Finding, ...] = ()  # what the attitudes contradict by themselves

    @property
    def reference(self) -> str:
        """Name of the star camera that defines frame s."""
        return self.heads[0].head.name
