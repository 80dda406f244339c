"""Stars that a strip of the sky must show and that were not found in it, CCD by CCD.

The catalogue and the estimated matrix tell where each bright star crosses which detector. No cloud hides it:
a CCD, or a strip, in which many are missing is not where the dump says it is, or holds another image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.ledger import Kind, Ledger, Reason
from boresight.geometry.record import Bools, Floats, Ints, array, record, scalar
from boresight.geometry.starlight import SurveyedStars, apparent_star_directions
from boresight.pipeline.diagnosis.losses import OF_STARS, lost_ccds
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.star_tables import survey_of
from boresight.pipeline.stages.sky_side import SkySide, name_in_sky_strips, scatter_px
from boresight.pipeline.stages.sky_strip import NOT_STATED_PX, NamedStars, SkyTask
from boresight.star_id.strip_stars.find import StripStars

__all__ = [
    "Crossings",
    "as_bright_as_named",
    "crossings",
    "displaced_stars",
    "named_alone",
    "names",
    "only",
    "star_ledger",
    "stars_found",
]

FEWEST = 3  # stars that agree by themselves
NODES = 33  # lines between which a star's way is straight
FAINTEST = 0.95  # of the stars that were named, in order of magnitude: brighter ones are looked for
NEAR_SIGMAS = 5.0  # of where the matrix places a star: a detection is that star, as in giving names
FEWEST_DISPLACED = 2  # missing stars of a CCD that are looked for elsewhere on it
FAR_PX = 100.0  # from its place, within which a missing star is looked for (set by hand)
ALIKE_MAG = 0.5  # between the brightness of a star and of a detection that may be it
EDGE_PX = 8.0  # from the ends of detector and strip within which a star is not counted


@record(kw_only=True)
class Crossings:
    """Catalogue stars that cross detectors of a strip. Row n of every array is the same crossing."""

    strip_id: str = scalar("strip")
    star: Ints = array("N", "row of the catalogue")
    ccd: Ints = array("N", "CCD of the camera, from 0")
    xy_px: Floats = array("N, 2", "where: (sample, line)")


def crossings(task: SkyTask, survey: SurveyedStars, R_cs: Rotation) -> Crossings:
    """Where single stars of a catalogue cross the detectors of a strip by the matrix `R_cs`."""
    lines: Floats = np.linspace(0.0, max(task.strip.lines - 1.0, 1.0), NODES, dtype=np.float64)
    t_s = task.instants(lines)
    p_i, v_i = task.orbit.states_i(t_s[[NODES // 2]])
    places = survey.places
    u_i = apparent_star_directions(places, task.epoch, float(t_s[NODES // 2]), p_i[0], v_i[0])
    R_ci = (R_cs * task.track.R_si(t_s)).as_matrix()
    ahead = np.flatnonzero(survey.single & ((u_i @ R_ci[:, 2].T).max(axis=1) > np.cos(_reach(task))))
    u_c = np.einsum("lab,sb->lsa", R_ci, u_i[ahead])
    found: list[tuple[Ints, Ints, Floats]] = []
    for ccd in task.strip.images.ccds:
        sample, across = (
            part.reshape(NODES, len(ahead))
            for part in task.camera.samples_from_directions(ccd, u_c.reshape(-1, 3))
        )
        node, star = np.nonzero(across[:-1] * across[1:] <= 0.0)
        part = across[node, star] / (across[node, star] - across[node + 1, star])
        line = lines[node] + part * (lines[node + 1] - lines[node])
        at = sample[node, star] + part * (sample[node + 1, star] - sample[node, star])
        last = task.camera.n_px(ccd) - 1.0, task.strip.lines - 1.0
        inside = (at > EDGE_PX) & (at < last[0] - EDGE_PX) & (line > EDGE_PX) & (line < last[1] - EDGE_PX)
        rows = ahead[star[inside]]
        found.append((rows, np.full(len(rows), ccd), np.column_stack([at, line])[inside]))
    star_of, ccd_of, xy_px = (np.concatenate(part) for part in zip(*found))
    return Crossings(strip_id=task.strip.strip_id, star=star_of, ccd=ccd_of, xy_px=xy_px)


def _reach(task: SkyTask) -> float:
    """Angle from the camera's axis beyond which no pixel looks."""
    ends = [
        task.camera.directions_from_pixels(ccd, np.array([0.0, task.camera.n_px(ccd) - 1.0]))
        for ccd in task.strip.images.ccds
    ]
    return float(np.arccos(np.concatenate(ends)[:, 2].min())) + 1e-3


def as_bright_as_named(survey: SurveyedStars, named: Sequence[NamedStars]) -> SurveyedStars:
    """Stars of a catalogue as bright as those that were named in any strip: none, if none was."""
    magnitudes = np.concatenate([one.places.places.v_mag for one in named] or [np.zeros(0)])
    faintest = np.quantile(magnitudes, FAINTEST) if len(magnitudes) else -np.inf
    return survey.take(np.flatnonzero(survey.places.v_mag <= faintest))


def stars_found(dump: Dump, task: SkyTask, found: StripStars, expected: Crossings) -> Bools:
    """Which of the stars (N,) that must be in a strip have a detection where they must be."""
    near_px, seen = _near_px(dump, task), np.zeros(len(expected.ccd), dtype=bool)
    for ccd in task.strip.images.ccds:
        here = expected.ccd == ccd
        off_px = np.abs(expected.xy_px[here, None] - found.xy_px[found.ccd == ccd]).max(axis=2)
        seen[here] = (off_px < near_px).any(axis=1)
    return seen


def _near_px(dump: Dump, task: SkyTask) -> float:
    """How far a star may lie from where a right matrix places it: by the errors of the attitudes, the stated
    scatter and what is not stated.
    """
    variance = np.einsum("kaka->ka", task.covariance_c)  # rad², axes of c
    attitude = np.sqrt(np.max(variance[:, :2].max(axis=1) + variance[:, 2] * _reach(task) ** 2))
    sigma_px = (scatter_px(dump, task), NOT_STATED_PX, float(attitude) / task.camera.pixel_rad)
    return NEAR_SIGMAS * float(np.linalg.norm(sigma_px))


def star_ledger(dump: Dump, side: SkySide, named: Sequence[NamedStars], R_cs: Rotation) -> Ledger:
    """Bright stars of each strip, found or not; without rows where no strip of the sky has a name."""
    strips = tuple(task.strip.strip_id for task in side.tasks)
    if not any(len(stars.rows) for stars in named):
        return Ledger.without_rows(Kind.STAR, strips)
    bright = as_bright_as_named(survey_of(dump.star_catalogue), named)
    every = [crossings(task, bright, R_cs) for task in side.tasks]
    found = [
        stars_found(dump, task, stars.found, expected)
        for task, stars, expected in zip(side.tasks, named, every)
    ]
    star = np.concatenate([expected.star for expected in every])
    last = [
        np.array([task.camera.n_px(ccd) - 1.0 for ccd in range(task.camera.n_ccds)]) for task in side.tasks
    ]
    parts = [expected.xy_px[:, 0] / ends[expected.ccd] for ends, expected in zip(last, every)]
    return Ledger(
        kind=Kind.STAR,
        strips=strips,
        strip=np.repeat(np.arange(len(every)), [len(expected.ccd) for expected in every]),
        ccd=np.concatenate([expected.ccd for expected in every]),
        id=np.array([f"{bright.name} {n}" for n in bright.places.hip[star].tolist()], dtype=str),
        part=np.concatenate(parts),
        along=np.concatenate(
            [each.xy_px[:, 1] / max(task.strip.lines - 1.0, 1.0) for task, each in zip(side.tasks, every)]
        ),
        magnitude=bright.places.v_mag[star],
        reason=np.where(np.concatenate(found), 0, Reason.NOT_IN_PLACE.number),
    )


def named_alone(dump: Dump, side: SkySide, ledger: Ledger) -> list[NamedStars]:
    """Stars of CCDs in which too many are missing, named by those CCDs alone: all such together or, where
    they do not agree, each by itself.
    """
    if not (lost := lost_ccds(ledger, OF_STARS)):
        return []
    for ccds in dict.fromkeys([tuple(lost), *((ccd,) for ccd in lost)]):
        of_ccds = replace(side, found=tuple(one.take(np.isin(one.ccd, ccds)) for one in side.found))
        if found := [one for one in _named(dump, of_ccds) if len(one.rows) >= FEWEST]:
            return found
    return []


def displaced_stars(
    dump: Dump, side: SkySide, named: Sequence[NamedStars], ledger: Ledger, R_cs: Rotation
) -> list[NamedStars]:
    """Missing stars of single CCDs with the detections, of their brightness and farther off than a right
    matrix allows, that may be them: the tests of inputs say whether one error of the CCD explains several.
    """
    if not any(n - found >= FEWEST_DISPLACED for found, n in ledger.cells().values()):
        return []
    survey = survey_of(dump.star_catalogue)
    bright, every = as_bright_as_named(survey, named), []
    for task, one in zip(side.tasks, named):
        if not len(one.rows):
            continue
        expected, near_px = crossings(task, bright, R_cs), _near_px(dump, task)
        level = float(np.median(_magnitude(one.found.flux_dn[one.rows]) - one.places.places.v_mag))
        pairs = list[tuple[int, int]]()
        for ccd in task.strip.images.ccds:
            rows, stars = np.flatnonzero(one.found.ccd == ccd), np.flatnonzero(expected.ccd == ccd)
            off_px = np.abs(expected.xy_px[stars, None] - one.found.xy_px[rows]).max(axis=2)
            lost = stars[~(off_px < near_px).any(axis=1)]
            if len(lost) < FEWEST_DISPLACED:
                continue
            free = rows[~(off_px < near_px).any(axis=0)]
            pairs += _of_brightness(expected, lost, one.found, free, bright, level)
        if pairs:
            row, star = np.array(pairs).T
            every.append(
                replace(
                    one,
                    rows=row,
                    places=bright.take(star),
                    probability_wrong=np.zeros(len(row)),
                    omissions=(),
                )
            )
    return every


def _magnitude(flux_dn: Floats) -> Floats:
    return -2.5 * np.log10(flux_dn)


def _of_brightness(
    expected: Crossings, lost: Ints, found: StripStars, free: Ints, bright: SurveyedStars, level: float
) -> list[tuple[int, int]]:
    """Detection and star of the catalogue, for each of the crossings `lost` the nearest of the detections
    `free` that is as bright; none of a single pair.
    """
    magnitude = _magnitude(found.flux_dn[free]) - level
    pairs: dict[int, int] = {}
    for n in lost.tolist():
        star = int(expected.star[n])
        off_px = np.hypot(*(found.xy_px[free] - expected.xy_px[n]).T)
        alike = (np.abs(magnitude - bright.places.v_mag[star]) < ALIKE_MAG) & (off_px < FAR_PX)
        if alike.any():
            pairs.setdefault(int(free[np.argmin(np.where(alike, off_px, np.inf))]), star)
    return list(pairs.items()) if len(pairs) >= FEWEST_DISPLACED else []


def _named(dump: Dump, side: SkySide) -> tuple[NamedStars, ...]:
    """Names by the pre-launch matrix."""
    return name_in_sky_strips(dump, side, dump.R_cs0, dump.sigma_installation_rad, known=False)


def names(dump: Dump, strip: SkySide) -> int:
    """How many stars of one strip of the sky have names by the pre-launch matrix."""
    return len(_named(dump, strip)[0].rows)


def only(side: SkySide, n: int) -> SkySide:
    """One strip of several."""
    return replace(
        side, tasks=(side.tasks[n],), found=(side.found[n],), computed=side.computed[n : n + 1], omissions=()
    )
