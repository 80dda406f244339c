"""Why a dump gives no result: the first thing that is missing, with numbers and what to check; or the reading
of an input, or the error of one, that explains that strips show nothing where they should.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain

import numpy as np

from boresight.calib.calibration import calibrate_strips
from boresight.calib.estimate import InstallationEstimate, NotObservable
from boresight.calib.finding import Finding
from boresight.geometry.sightings import StripSightings
from boresight.pipeline.diagnosis.input_findings import NOTHING, nearest_miss
from boresight.pipeline.diagnosis.moved_inputs import examined, moved_inputs
from boresight.pipeline.diagnosis.readings import (
    MIRRORED,
    are_mirrored,
    best_reading,
    readings_of_dump,
    reversed_in_ground,
    reversed_strips,
)
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_side import SolvedAttitudes, StarCentroids
from boresight.pipeline.run.cached import StageRunner
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.coverage import stated_mountings
from boresight.pipeline.stages.exposure import star_tasks
from boresight.pipeline.stages.head import Basis, HeadSightings, sight_head
from boresight.pipeline.stages.sky_side import SkySide, find_in_sky_strips, name_in_sky_strips
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, misses, pushbroom_of
from boresight.pipeline.stages.strip_tasks import strip_tasks
from boresight.records.ledger import Entry, Kind, Reason, list_words
from boresight.records.record import Floats

__all__ = ["cause_of_no_result", "what_is_missing", "wrong_convention"]

MIRROR_TRIALS = 3  # exposures
FEW_TARGETS = 4  # of a strip; fewer seldom exclude chance when the pre-launch matrix is uncertain
FEWEST_SEEN = 3  # targets of all strips by which a reading is judged: one or two are in view by chance


def what_is_missing(
    outcome: NotObservable,
    basis: Basis,
    tasks: Sequence[StripTask],
    matched: Sequence[MatchedTargets],
    omissions: Sequence[Entry],
) -> str:
    """One sentence for the user, the cause first."""
    dump, reference = basis.dump, basis.heads[0]
    n_stars = len(reference.stars)  # identified exposures
    n_targets = sum(len(one.target_id) for one in matched)
    counts = f"{n_stars} exposures identified, {n_targets} targets matched in {len(matched)} strips"
    failed = [entry for entry in omissions if entry.subject.kind is Kind.EXPOSURE]
    if failed and n_stars == 0:
        return f"{_no_exposure(dump, basis.settings, failed)}; {counts}"
    if n_stars and not reference.attitudes.usable.any():
        return f"{_no_attitude(reference)}; {counts}"
    every = [*omissions, *(o for one in matched for o in one.omissions)]
    of_targets = [entry for entry in every if entry.subject.kind is Kind.TARGET]
    if tasks and dump.targets and n_targets == 0 and not of_targets:
        return f"{_no_target(dump, tasks)}; {counts}"
    of_strips = [one for one in omissions if one.subject.kind is Kind.STRIP and one.reason in NOTHING]
    if of_strips and len({entry.subject for entry in of_strips}) == len(dump.strips) + len(dump.sky_strips):
        return f"no strip can be used: {list_words([entry.line for entry in of_strips], 1)}; {counts}"
    hidden = [entry for entry in of_targets if entry.reason is Reason.HIDDEN]
    if n_targets == 0 and len(hidden) == len(of_targets) > 0:
        text = f"none of {len(hidden)} measured points is in view of the satellite: check times and frame of "
        text += "the orbit, or that it is of this revolution, and lat_deg and lon_deg in points.csv"
        return f"{text}; {counts}; {hidden[0].subject.name}: {hidden[0].text}"
    lost = [entry for entry in of_targets if entry.reason is Reason.NO_COMMON_ROTATION]
    if n_targets == 0 and lost and len(lost) < FEW_TARGETS * len(matched):
        most = max(Counter(entry.subject.strip for entry in lost).values())
        text = f"too few targets: at most {most} in view of a strip, so few agree on one rotation by chance; "
        text += f"{FEW_TARGETS} or more in view of a strip are needed, near both ends of the swath"
        return f"{text}; {counts}; not used: {lost[0].line}"
    if stars := [entry for entry in every if entry.subject.kind is Kind.STAR]:
        counts = f"{n_stars} exposures identified, strips of the sky: {len(dump.sky_strips)}"
        return f"{outcome.reason}; {counts}{_unused_stars(stars)}"
    first, reason = f"; not used: {every[0].line}" if every else "", outcome.reason
    if n_targets == 0 and lost:
        reason = (
            "no target is found within 3 sigma_rad of the pre-launch matrix: check these, chips and images"
        )
    return f"{reason}; {counts}{first}"


def _unused_stars(stars: Sequence[Entry]) -> str:
    reasons = Counter(entry.reason for entry in stars).most_common()
    text = ", ".join(f"{n} {reason}" for reason, n in reasons)
    if reasons[0][0] is Reason.NAME_UNSURE:
        first = next(entry for entry in stars if entry.reason is Reason.NAME_UNSURE)
        text += f"; {first.subject.name}: {first.text}; state that error as small as it is, or raise "
        text += "max_name_error under [sky_strips] of the settings"
    return f"; stars in them that are not used: {text}"


def _no_exposure(dump: Dump, settings: Settings, failed: Sequence[Entry]) -> str:
    reasons = Counter(entry.reason for entry in failed).most_common()
    text = f"none of {len(failed)} exposures can be used ({', '.join(f'{n} {why}' for why, n in reasons)}); "
    text += f"{failed[0].subject.name}: {failed[0].text}"
    not_identified = {entry.subject for entry in failed if entry.reason is Reason.NOT_IDENTIFIED}
    tasks = [task for images in dump.star_images for task in star_tasks(dump, images, settings.stars)[0]]
    tried = [task for task in tasks if task.item.subject in not_identified][:MIRROR_TRIALS]
    if are_mirrored(tried):
        return f"{text}; {MIRRORED.changed} its stars are identified: the images are mirrored"
    if not_identified:
        text += "; check focal_length_mm and pixel_size_um of the star camera (`boresight identify IMAGE` "
        text += "measures the focal length), its distortion, the bit depth, and that images are not mirrored"
    return text


def _no_attitude(reference: HeadSightings) -> str:
    attitudes, source = reference.attitudes, reference.head.source
    text = f"none of {len(reference.stars)} exposures has an attitude: {int(np.sum(~attitudes.kept))} of "
    text += f"{len(attitudes.kept)} identified stars lie further from where the others put them than their "
    text += "stated errors allow; check "
    if isinstance(source, StarCentroids):
        text += f"sigma_x_px, sigma_y_px and cov_xy_px2 of {source.file}, and "
    return text + "focal length, principal point and distortion of the star camera"


def _no_target(dump: Dump, tasks: Sequence[StripTask]) -> str:
    across_m, along_m, along_s, target_id, strip_id = nearest_miss(tasks, dump.targets)
    if not np.isfinite(across_m):
        return (
            "no strip sees the Earth: by the attitudes and the orbit the camera looks past it; check axes "
            "and REF_FRAME of the orbit, and quaternion_cs of the pre-launch matrix (scalar last, s to c)"
        )
    return (
        f"no target comes into view: the nearest, {target_id}, misses strip {strip_id} by "
        f"{across_m / 1e3:.1f} km across the track and {along_m / 1e3:.1f} km along it ({along_s:.1f} s); "
        "check times and frame of the orbit, the strips' times, the targets' latitude and longitude and the "
        "pre-launch installation matrix"
    )


def cause_of_no_result(
    basis: Basis,
    sky: SkySide,
    strips: Sequence[StripSightings],
    tasks: Sequence[StripTask],
    matched: Sequence[MatchedTargets],
) -> Finding | None:
    """Why strips determine no matrix: the order of an image, a convention, or what hypotheses tell of all
    observations.
    """
    if basis.of_attitudes:
        return basis.of_attitudes[0]
    of_strips = chain(reversed_strips(basis.dump, sky), reversed_in_ground(tasks, matched))
    if finding := next(of_strips, None) or wrong_convention(basis):
        return finding
    plain = replace(basis.errors, robust=False)
    together = calibrate_strips(strips, basis.dump.R_cs0, plain) if strips else None
    if not isinstance(together, InstallationEstimate):
        return None
    found = examined(basis, together, strips, plain, moved_inputs(basis.dump, strips))
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


def _agreeing_strips(basis: Basis, dump: Dump) -> int:
    """Strips of a dump read otherwise than `basis` that see stars or targets by pre-launch matrices; targets
    count where they are not too few.
    """
    runner, settings = StageRunner(None, InOrder()), basis.settings
    heads = [
        sight_head(dump, head, settings, runner)
        if isinstance(head.source, SolvedAttitudes)
        else replace(before, head=head)
        for head, before in zip(dump.heads, basis.heads)
    ]
    start = dump.R_cs0, dump.sigma_installation_rad
    tasks, _ = strip_tasks(dump, heads, *start, stated_mountings(heads), settings, with_slips=False)
    named = name_in_sky_strips(dump, find_in_sky_strips(dump, heads, settings, runner), *start, known=False)
    seen = [_targets_seen(task, dump) for task in tasks]
    of_ground = np.count_nonzero(seen) if sum(seen) >= FEWEST_SEEN else 0
    return of_ground + sum(len(one.rows) > 0 for one in named)


def _targets_seen(task: StripTask, dump: Dump) -> int:
    """Targets that a strip shows, or its measured points where most lie as the pre-launch matrix allows."""
    points = task.points
    if not len(points.ccd):
        outside = misses(task, dump.targets)[0] if dump.targets else np.full((1, 2), np.nan)
        return int((np.hypot(*outside.T) == 0.0).sum())
    limit_px = task.settings.sigmas * float(task.sigma_installation_rad.max()) / task.camera.pixel_rad
    p_e = np.array([target.p_e for target in points.targets])
    near: Floats = np.zeros(len(points.ccd))
    for ccd in np.unique(points.ccd).tolist():
        here = points.ccd == ccd
        sample, line = pushbroom_of(task).pixels_from_ground(ccd, p_e[here])
        off_px = np.hypot(sample - points.xy_px[here, 0], line - points.xy_px[here, 1])
        near[here] = np.nan_to_num(off_px, nan=np.inf) < limit_px
    return int(near.sum()) if near.mean() > 0.5 else 0
