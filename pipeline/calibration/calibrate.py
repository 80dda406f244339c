"""From an open dump to the installation matrix: the whole calculation on one screen.

    each exposure -> identified stars (`sight_head`)
    each strip of the sky -> detections (`find_in_sky_strips`)
    strips -> matched targets and named stars -> calib.calibrate_strips -> R_cs, and once more with that R_cs,
    where templates were not predicted as well (`first_and_last_round`)
    R_cs and all that was measured -> verdict and findings (`assessed`)

With a store, finished work is on disk. In whatever order tasks finish, sums are made in the order of time and
id, so the result is the same bit for bit.
"""

from __future__ import annotations

from boresight.calib.estimate import InstallationEstimate
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import Verdict
from boresight.geometry.line_camera import LineSensor
from boresight.geometry.sightings import ExposureAttitudes, StarSightings, StripSightings
from boresight.pipeline.calibration.assessment import Assessment, assessed
from boresight.pipeline.calibration.rounds import Round, first_and_last_round, unused_so_far
from boresight.pipeline.diagnosis.own_motion import against_own_motion
from boresight.pipeline.diagnosis.unused_rows import Rows, rows_used, unused_rows
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.repeats import targets_once
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.run.cached import Progress, StageRunner
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.run.unit_store import UnitStore
from boresight.pipeline.stages.head import Basis, HeadSightings, sight_head
from boresight.pipeline.stages.sky_side import SkySide, find_in_sky_strips
from boresight.pipeline.stages.sky_strip import NamedStars
from boresight.pipeline.stages.strip import MatchedTargets, StripTask
from boresight.records.ledger import Entry
from boresight.records.record import inner, record, scalar

__all__ = ["DumpCalibration", "calibrate_dump"]


@record(kw_only=True)
class DumpCalibration:
    """Everything that a calibration found, ready to be written or drawn."""

    estimate: InstallationEstimate = scalar("installation matrix with covariance and statistics")
    reference: HeadSightings = scalar("star camera that defines frame s")
    last: Round = scalar("last matching and estimation")
    assessment: Assessment = scalar("what is said of the estimate")
    settings: CalibrationSettings = scalar("of the estimate, with the dump's stated errors")
    omissions: tuple[Entry, ...] = scalar("everything that is not used, with reasons")
    rows: tuple[Rows, ...] = scalar("how many rows of each table the estimate depends on")
    n_computed: int = scalar("exposures and strips that were computed in this run")
    n_reused: int = scalar("those that were read from the store")

    stars = inner[tuple[StarSightings, ...]]("reference.stars", "identified exposures, in order of time")
    attitudes = inner[ExposureAttitudes]("reference.attitudes", "attitudes of the same exposures")
    tasks = inner[tuple[StripTask, ...]]("last.tasks", "strips of the last matching")
    matched = inner[tuple[MatchedTargets, ...]]("last.matched", "targets matched in the same strips")
    sky = inner[SkySide]("last.sky", "strips of the sky with their detections")
    named = inner[tuple[NamedStars, ...]]("last.named", "named stars of the same strips")
    observed = inner[tuple[MatchedTargets, ...]]("last.observed", "targets and named stars")
    strips = inner[tuple[StripSightings, ...]]("last.strips", "of the estimate, ground first")
    verdict = inner[Verdict]("assessment.verdict", "whether the data contradict themselves")

    @property
    def camera(self) -> LineSensor:
        """Model of the remote-sensing camera."""
        return self.tasks[0].camera if self.tasks else self.sky.tasks[0].camera

    @property
    def ground_strips(self) -> tuple[StripSightings, ...]:
        """The strips of the ground."""
        return tuple(strip for strip in self.strips if not strip.ground.is_star.any())


def calibrate_dump(
    dump: Dump,
    settings: Settings | None = None,
    store: UnitStore | None = None,
    executor: Executor | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> DumpCalibration:
    """Installation matrix of a dump, estimated from its raw images; `DataNotSufficientError` if the data do
    not determine all three angles.

    `settings` default to the dump's stated errors. Finished exposures and strips are kept in `store` and
    looked for there, else all is in memory; `executor` computes, else this process, one task after another.
    `progress` is called with the stage's name, the tasks done and all tasks.
    """
    settings = settings or Settings()
    dump = targets_once(dump, settings.match)
    runner = StageRunner(store, executor or InOrder(), progress)
    errors = calibration_settings(settings, dump.errors, dump.line_camera)
    heads = tuple(sight_head(dump, head, settings, runner) for head in dump.heads)
    sky = find_in_sky_strips(dump, heads, settings, runner)
    surface = surface_of(dump.terrain)  # in memory: processes forked from here share it
    of_attitudes = tuple(against_own_motion(heads, settings.verdict))
    basis = Basis(dump, heads, settings, errors, runner, surface, of_attitudes)
    first, last = first_and_last_round(basis, sky)
    found = last.estimate.with_reference(basis.reference)
    omissions = (
        *unused_so_far(basis, sky),
        *last.omissions,
        *found.rejected,
        *unused_rows(dump, last.tasks, last.observed, settings.run.exposure_margin_s),
    )
    return DumpCalibration(
        estimate=found,
        reference=heads[0],
        last=last,
        assessment=assessed(basis, first, last, found, omissions),
        settings=errors,
        omissions=omissions,
        rows=rows_used(dump, found, last.strips),
        n_computed=runner.computed[True],
        n_reused=runner.computed[False],
    )
