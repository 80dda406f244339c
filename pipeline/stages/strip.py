"""From one strip to matched targets (`MatchedTargets`), and from these to directions (`GroundSightings`).

    attitudes of the star exposures around the strip, current R_cs -> predicted templates -> image positions
    position -> look direction u_c (column) and instant (row); target - satellite -> apparent direction u_i

A task holds all that the outcome of one strip depends on. Matching takes long and its outcome is kept on
disk; the directions are computed from it each time.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.gct_match.imaging.views import in_counts
from boresight.gct_match.match import keep_whole, match_strip
from boresight.gct_match.predict.scene import scene_of
from boresight.gct_match.predict.trajectories import displacements
from boresight.gct_match.records import Chip, StripMatches, Target, TargetMatch
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.attitude import AttitudeTrack, Interpolation
from boresight.geometry.attitude_estimate import cross_matrices
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.geometry.groundlight import LightEffects, apparent_ground_directions, moves_by_light
from boresight.geometry.line_camera import LineSensor
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.sightings import GroundReferences, GroundSightings
from boresight.geometry.terrain import ConstantHeight
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.coordinate_slips import contradiction
from boresight.pipeline.files.ground_points import NO_POINTS, ChipFile, StripPoints
from boresight.pipeline.files.images.rasters import read_grid
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.files.terrain_files import TargetHeights, TerrainFiles, surface_of
from boresight.pipeline.run.executor import Executor, InOrder
from boresight.pipeline.stages.match_pictures import NO_PICTURES, MatchPictures, match_pictures
from boresight.records.ledger import Entry, Kind, Reason, State, Subject
from boresight.records.record import Floats, Ints, RowRecord, Texts, array, inner, record, scalar

__all__ = [
    "MatchedTargets",
    "StripTask",
    "compass",
    "contradicting_targets",
    "displaced_m",
    "footprint_e",
    "ground_sightings",
    "match_strip_targets",
    "measured_points",
    "misses",
    "pictures_of_match",
    "predicted_again",
    "pushbroom_of",
    "read_chip",
    "strip_matches",
    "targets_near",
    "unreadable_chips",
    "with_points",
]

# Most pixels of a chip.
MAX_CHIP_PIXELS = 4096 * 4096
# Targets are looked for so far from the middle of a footprint: times its half diagonal, and beyond that.
NEAR, NEAR_M = 1.2, 2e4
NAMED = 0.1  # of a displacement, below which its part north or east is not named
NOTHING = np.empty((0, 0), np.float32)  # in the place of a picture that is not kept
MOST_CHIPS = 256  # of a strip in memory: 100 MB of 200 x 200 px; of more each is read thrice
IN_ORDER = InOrder()  # the executor where none is given: this process


@record(kw_only=True)
class StripTask:
    """One strip and everything that the positions of its targets depend on."""

    strip: Strip = scalar("images and times of the strip")
    camera: LineSensor = scalar("model of the remote-sensing camera")
    orbit: Orbit = scalar("states around the strip")
    t_attitude_s: Floats = array("K", "exposures around the strip, TAI seconds since the dump's epoch")
    R_si: Rotation = array("K", "their attitudes, GCRS to star camera")
    cov_s: Floats | None = array("K, 3, 3", "of smoothed attitudes, rad²; None: not smoothed", default=None)
    R_cs: Rotation = scalar("installation matrix to start from")
    sigma_installation_rad: Floats = array("3", "1-sigma of its error, rad, axes of c")
    is_known: bool = scalar("whether targets of other strips gave that matrix", default=False)
    effects: LightEffects = scalar("effects on the line of sight that are modelled")
    targets: tuple[Target, ...] = array("N", "targets that the strip may show in its images")
    chips: tuple[ChipFile, ...] = array("N", "their image chips")
    terrain: TerrainFiles | TargetHeights = scalar("heights of the ground")
    settings: MatchSettings = scalar("limits of the matching")
    interpolation: Interpolation = scalar("between the attitudes", default="lagrange")
    points: StripPoints = scalar("ground points measured in it by others", default=NO_POINTS)
    carrier: str = scalar("head whose attitudes these are; empty: the reference head", default="")

    item = inner[Entry]("strip.item", "what is processed, without a reason")

    @property
    def places(self) -> dict[str, Target]:
        """Its targets and measured points by id."""
        return {target.target_id: target for target in (*self.targets, *self.points.targets)}


@record(kw_only=True)
class MatchedTargets(RowRecord):
    """Targets matched in one strip. Row n of every array is the same match."""

    strip_id: str = scalar("id of the strip in the dump")
    target_id: Texts = array("N", "ids of the targets in the dump")
    ccd: Ints = array("N", "CCD of the camera, from 0")
    xy_px: Floats = array("N, 2", "measured position (sample, line)")
    cov_px: Floats = array("N, 2, 2", "its covariance, px²")
    correlation: Floats = array("N", "of template and strip")
    probability_wrong: Floats = array("N", "probability that the position is a false match")
    predicted_px: Floats = array("N, 2", "position predicted with the initial installation matrix")
    affine: Floats = array("N, 2, 2", "A - I of the affine map from chip to strip; zero for a translation")
    pictures: tuple[MatchPictures, ...] = array("N", "template, strip and correlation surface")
    omissions: tuple[Entry, ...] = scalar("unreadable chips, targets that were rejected", default=())
    farthest_px: float = scalar("largest distance on an axis from a prediction; 0: no template", default=0.0)

    def told(self) -> list[str]:
        """Lines of the log: counts, and each reason why something is not used."""
        reasons = Counter(entry.reason for entry in self.omissions)
        text = f"{self.strip_id}: {len(self.target_id)} targets matched"
        text += "".join(f", {n} {reason}" for reason, n in reasons.most_common())
        return [text, *(f"{entry.subject.name}: {entry.text}" for entry in self.omissions)]

    @property
    def contradicting(self) -> tuple[Entry, ...]:
        """Targets whose positions were measured and contradict those of the other targets of the strip."""
        return tuple(entry for entry in self.omissions if entry.xy_px)


def pushbroom_of(task: StripTask) -> Pushbroom:
    """Rigorous model of the strip with the installation matrix of the task."""
    return Pushbroom(
        camera=task.camera,
        rows=task.strip.clock,
        orbit=task.orbit,
        earth=task.orbit.earth,
        attitude=AttitudeTrack(
            task.t_attitude_s,
            task.R_si,
            task.orbit,
            task.cov_s,
            interpolation=task.interpolation,
            is_smoothed=task.cov_s is not None,
        ),
        R_cs=task.R_cs,
        effects=task.effects,
    )


def match_strip_targets(task: StripTask, parts: Executor = IN_ORDER) -> MatchedTargets | Entry:
    """Positions of the targets of one strip; none and an omission where an image of the strip is damaged.

    `parts` reads the images of a wide search.
    """
    pictures: dict[tuple[str, int], MatchPictures] = {}

    def keep(match: TargetMatch) -> TargetMatch:
        pictures[match.target_id, match.ccd] = pictures_of_match(match)
        return replace(match, template=NOTHING, found=NOTHING, residual=NOTHING, surface=NOTHING)

    result, omitted = strip_matches(task, parts, keep) if task.targets else (None, [])
    matches, refused = (result.matches, result.refused) if result else ((), ())
    omitted += [_not_matched(task, one) for one in refused if one.state is not State.OUT_OF_VIEW]
    return _matched(task.strip.strip_id, matches, omitted, pictures)


def pictures_of_match(match: TargetMatch) -> MatchPictures:
    """Pictures of a match with its template, what was found, residual and correlation surface."""
    middle = 0.5 * (np.array(match.surface.shape[::-1]) - 1.0)  # the search goes as far to all sides
    images = match.template, match.found, match.residual, match.surface
    off_px = match.xy_px - match.expected_px
    return match_pictures(*images, in_chip=match.place_px, in_surface=middle, off_px=off_px)


def measured_points(
    strip_id: str,
    target_id: Texts,
    ccd: Ints,
    xy_px: Floats,
    cov_px: Floats,
    probability_wrong: Floats | None = None,
) -> MatchedTargets:
    """Image points (N, 2), covariances (N, 2, 2), of no template: NaN where matching gives a number."""
    n = len(ccd)
    unknown = np.full(n, np.nan)
    return MatchedTargets(
        strip_id=strip_id,
        target_id=target_id,
        ccd=ccd,
        xy_px=xy_px,
        cov_px=cov_px,
        correlation=unknown,
        probability_wrong=unknown if probability_wrong is None else probability_wrong,
        predicted_px=np.full((n, 2), np.nan),
        affine=np.full((n, 2, 2), np.nan),
        pictures=(NO_PICTURES,) * n,
    )


def contradicting_targets(matched: MatchedTargets) -> MatchedTargets:
    """The positions of a strip that contradict the others, as matched targets of it."""
    rows, n = matched.contradicting, len(matched.contradicting)
    xx, xy, yy = np.array([entry.cov_px for entry in rows], dtype=float).reshape(n, 3).T
    return measured_points(
        matched.strip_id,
        np.array([entry.subject.id for entry in rows], dtype=str),
        np.array([entry.subject.ccd for entry in rows], dtype=np.int64),
        np.array([entry.xy_px for entry in rows], dtype=float).reshape(n, 2),
        np.stack([xx, xy, xy, yy], axis=1).reshape(n, 2, 2),
    )


def with_points(outcome: MatchedTargets | Entry, points: StripPoints) -> MatchedTargets:
    """The matched targets of a strip, none where it cannot be used, and points that others measured in it."""
    if isinstance(outcome, Entry):
        outcome = _matched(outcome.subject.strip, (), [outcome], {})
    names = np.array([target.target_id for target in points.targets], dtype=str)
    measured = measured_points(outcome.strip_id, names, points.ccd, points.xy_px, points.cov_px)
    return MatchedTargets.together([outcome, measured])


def _matched(
    strip_id: str,
    matches: Sequence[TargetMatch],
    omissions: Sequence[Entry],
    pictures: Mapping[tuple[str, int], MatchPictures],
) -> MatchedTargets:
    matches, n = sorted(matches, key=lambda m: (m.target_id, m.ccd)), len(matches)
    return MatchedTargets(
        strip_id=strip_id,
        target_id=np.array([m.target_id for m in matches], dtype=str),
        ccd=np.array([m.ccd for m in matches], dtype=np.int64),
        xy_px=np.array([m.xy_px for m in matches], dtype=float).reshape(n, 2),
        cov_px=np.array([m.cov_px for m in matches], dtype=float).reshape(n, 2, 2),
        correlation=np.array([m.correlation for m in matches], dtype=float),
        probability_wrong=np.array([m.probability_wrong for m in matches], dtype=float),
        predicted_px=np.array([m.predicted_px for m in matches], dtype=float).reshape(n, 2),
        affine=np.array([m.affine for m in matches], dtype=float).reshape(n, 2, 2),
        pictures=tuple(pictures[m.target_id, m.ccd] for m in matches),
        omissions=tuple(omissions),
        farthest_px=max((float(np.abs(m.xy_px - m.expected_px).max()) for m in matches), default=0.0),
    )


class _Chips(Sequence[Chip]):
    """Chips that are read from their files when they are asked for; the last of them stay in memory."""

    def __init__(self, read: Callable[[int], Chip], numbers: Sequence[int]) -> None:
        self._read, self._numbers = read, numbers

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, n: Any) -> Any:
        return self._read(self._numbers[n])


def strip_matches(
    task: StripTask, parts: Executor = IN_ORDER, keep: Callable[[TargetMatch], TargetMatch] = keep_whole
) -> tuple[StripMatches | None, list[Entry]]:
    """The matcher's outcome (None: damaged images), and unreadable files; `keep`: what is kept of a match."""
    read = lru_cache(maxsize=MOST_CHIPS)(lambda n: read_chip(task.chips[n]))
    readable, omitted = _readable(task.chips, read)

    try:
        scene = scene_of(
            task.strip.images,
            pushbroom_of(task),
            [task.targets[n] for n in readable],
            _Chips(read, readable),
            surface_of(task.terrain),
            task.sigma_installation_rad,
            task.settings,
            task.is_known,
        )
        result = match_strip(scene, each=partial(parts.map, done=lambda n, outcome: None), keep=keep)
    except RawDataError as error:
        omitted.append(Entry(task.strip.subject, Reason.UNREADABLE, str(error), error.file))
        return None, omitted
    return result, omitted


def predicted_again(matched: MatchedTargets, task: StripTask) -> MatchedTargets:
    """The matched targets of a strip, with the positions that the matrix of the task predicts."""
    place = task.places
    n = len(matched.ccd) - len(task.points.ccd)  # points measured by others come last: see `with_points`
    p_e = np.array([place[name].p_e for name in matched.target_id[:n].tolist()], dtype=float).reshape(n, 3)
    off_px, _ = displacements(pushbroom_of(task), p_e, matched.ccd[:n], matched.xy_px[:n])
    predicted_px = matched.predicted_px.copy()
    predicted_px[:n] = matched.xy_px[:n] - off_px
    return replace(matched, predicted_px=predicted_px)


def unreadable_chips(files: Sequence[ChipFile]) -> list[Entry]:
    """Chips that cannot be read, with the reasons."""
    return _readable(files, lambda n: read_chip(files[n]))[1]


def _readable(files: Sequence[ChipFile], read: Callable[[int], Chip]) -> tuple[list[int], list[Entry]]:
    """Numbers of the chips that can be read, and entries for the others."""
    readable, omitted = [], []
    for n, file in enumerate(files):
        try:
            read(n)
            readable.append(n)
        except RawDataError as error:
            chip = Subject(Kind.CHIP, id=file.target_id)
            omitted.append(Entry(chip, Reason.UNREADABLE, str(error), file.file))
    return readable, omitted


def read_chip(file: ChipFile) -> Chip:
    """A chip with its geo-reference; `RawDataError` if it cannot be read."""
    grid = read_grid(file.path, file.file, max_pixels=MAX_CHIP_PIXELS)
    valid = np.isfinite(grid.values)
    image = in_counts(np.where(valid, grid.values, 0.0), valid)
    return Chip(file.target_id, image, grid.transform, grid.crs, valid)


def _not_matched(task: StripTask, refusal: Entry) -> Entry:
    """The matcher's entry with strip, file and what its place or chip tells."""
    strip, subject = task.strip, refusal.subject
    detail, slip = "", ""
    if refusal.reason is Reason.INCONSISTENT:
        model, place_e = pushbroom_of(task), task.places[subject.id].p_e
        predicted_px = np.concatenate(model.pixels_from_ground(subject.ccd, place_e[None]))
        off = compass(*displaced_m(model, place_e, subject.ccd, (predicted_px + refusal.more).tolist()))
        detail = f"its chip or coordinates lie about {off} of the true place"
    elif refusal.reason is Reason.OUTSIDE_CHIP:
        n = next(n for n, target in enumerate(task.targets) if target.target_id == subject.id)
        detail, slip = contradiction(task.targets[n], task.chips[n], task.chips)
    return replace(
        refusal,
        subject=replace(subject, strip=strip.strip_id),
        detail=detail,
        file=strip.images.names.get(subject.ccd, ""),
        slip=slip,
    )


def displaced_m(model: Pushbroom, p_e: Floats, ccd: int, xy_px: Sequence[float]) -> tuple[float, float]:
    """How far a place (3,), frame e, lies east and north of that shown at (sample, line), m."""
    lat, lon, height = geodetic_from_ecef(p_e[None])
    level = ConstantHeight(float(height[0]))
    there = model.ground_points(ccd, np.array([xy_px[0]]), np.array([xy_px[1]]), level)
    east_m, north_m = (local_axes_e(lat, lon)[0].T @ (p_e - there[0]))[:2].tolist()
    return east_m, north_m


def compass(east_m: float, north_m: float) -> str:
    """A horizontal displacement in words: "60 m west, 14 m north"; a part below a tenth is not named."""
    parts = ((east_m, "east", "west"), (north_m, "north", "south"))
    least = NAMED * float(np.hypot(east_m, north_m))
    words = [f"{abs(v):.3g} m {plus if v > 0 else minus}" for v, plus, minus in parts if abs(v) > least]
    return ", ".join(words)


def ground_sightings(matched: MatchedTargets, task: StripTask) -> GroundSightings:
    """Directions of the matched targets: measured by the camera, and computed from ground and orbit."""
    model = pushbroom_of(task)
    place = task.places
    rows = [place[name] for name in matched.target_id.tolist()]
    p_e = np.array([target.p_e for target in rows], dtype=float).reshape(-1, 3)
    sigma_m = np.array([target.sigma_m for target in rows], dtype=float).reshape(-1, 3)
    t_s = np.asarray(model.instants_of_lines(matched.ccd, matched.xy_px[:, 1]), dtype=float)
    u_c, jacobian = model.directions_and_jacobian(matched.ccd, matched.xy_px)
    u_i, range_m = apparent_ground_directions(p_e, t_s, task.orbit, task.orbit.earth, task.effects)
    R_ie = task.orbit.earth.matrices_ie(t_s)
    lat, lon, _ = geodetic_from_ecef(p_e)
    axes_i = R_ie @ local_axes_e(lat, lon)
    return GroundSightings(
        target_id=matched.target_id,
        ccd=matched.ccd,
        xy_px=matched.xy_px,
        t_s=t_s,
        u_c=u_c,
        u_i=u_i,
        cov_c=jacobian @ matched.cov_px @ np.swapaxes(jacobian, 1, 2),
        range_m=range_m,
        v_rel_i=np.einsum("nij,nj->ni", R_ie, task.orbit.velocities_e(t_s)),
        cov_target_i=(axes_i * sigma_m[:, None, :] ** 2) @ np.swapaxes(axes_i, 1, 2),
        earth_i=_by_earth_orientation(task.orbit, p_e, t_s, u_i, range_m),
        light_i=moves_by_light(p_e, t_s, task.orbit, task.orbit.earth, task.effects),
        references=_references(rows, p_e, axes_i),
    )


def _references(targets: Sequence[Target], p_e: Floats, axes_i: Floats) -> GroundReferences | None:
    """The references of targets (N,) at places (N, 3), with their axes east, north and up (N, 3, 3)."""
    of = [target.reference for target in targets]
    if not any(of):
        return None
    length_m = np.array([one.length_m if one else 0.0 for one in of])[:, None]
    return GroundReferences(
        name=np.array([one.name if one else "" for one in of], dtype=str),
        axes_i=axes_i,
        sigma_m=np.array([one.sigma_m if one else np.zeros(3) for one in of]),
        place=np.divide(p_e, length_m, out=np.zeros_like(p_e), where=length_m > 0.0),
    )


def _by_earth_orientation(orbit: Orbit, p_e: Floats, t_s: Floats, u_i: Floats, range_m: Floats) -> Floats:
    """Change (N, 3, 3) of directions u_i by the 1-sigma rotations of the Earth, as `GroundSightings.earth_i`.

    A rotation by a small vector a moves a ground point by R_ie (a x p_e), and a satellite whose orbit is
    stated in ITRF likewise.
    """
    earth = orbit.earth
    if not earth.sigma_e_rad.any():
        return np.zeros((len(t_s), 3, 3))
    lever_e = p_e - orbit.positions_e(t_s) if orbit.frame == "ITRF" else p_e
    moved_i = -earth.matrices_ie(t_s) @ cross_matrices(lever_e) * earth.sigma_e_rad
    across = np.eye(3) - u_i[:, :, None] * u_i[:, None, :]
    return np.asarray(across @ moved_i / range_m[:, None, None])


def targets_near(
    task: StripTask, targets: Sequence[Target], chips: Sequence[ChipFile]
) -> tuple[tuple[Target, ...], tuple[ChipFile, ...]]:
    """Targets and chips that the strip might show, with a margin: all that its outcome depends on."""
    if not targets:
        return (), ()
    model = pushbroom_of(task)
    corners_e = footprint_e(task).reshape(-1, 3)
    ground_e = corners_e[np.isfinite(corners_e).all(axis=1)]
    if not len(ground_e):
        return (), ()
    middle = ground_e.mean(axis=0)
    reach = float(np.linalg.norm(ground_e - middle, axis=1).max())
    satellite = task.orbit.positions_e(model.instants(np.array([0.5 * (task.strip.lines - 1.0)])))[0]
    distance = float(np.linalg.norm(satellite - middle))
    shift = 2.0 * task.settings.sigmas * float(task.sigma_installation_rad.max())
    reach = NEAR * reach + distance * shift + NEAR_M
    near = [n for n, target in enumerate(targets) if np.linalg.norm(target.p_e - middle) <= reach]
    return tuple(targets[n] for n in near), tuple(chips[n] for n in near)


def footprint_e(task: StripTask) -> Floats:
    """Points on the ellipsoid (2 C, 9, 3), ITRS, m: both ends of each of the C CCDs at 9 of its lines."""
    model, seen = pushbroom_of(task), []
    for ccd, n_lines in sorted(task.strip.ccd_lines.items()):
        lines = np.linspace(0.0, n_lines - 1.0, 9)
        ends = np.repeat([0.0, task.camera.n_px(ccd) - 1.0], len(lines))
        seen.append(model.ground_points(ccd, ends, np.tile(lines, 2), ConstantHeight(0.0)))
    return np.concatenate(seen).reshape(-1, 9, 3)


def misses(task: StripTask, targets: Sequence[Target]) -> tuple[Floats, float]:
    """How far targets (N, 2) lie across and along the track outside a footprint, m; its ground speed, m/s."""
    seen_e = footprint_e(task)
    if not np.isfinite(seen_e[:, [0, -1]]).any(axis=(0, 2)).all():
        return np.full((len(targets), 2), np.nan), np.nan
    first, last = np.nanmean(seen_e[:, 0], axis=0), np.nanmean(seen_e[:, -1], axis=0)
    middle = 0.5 * (first + last)
    along = (last - first) / np.linalg.norm(last - first)
    across = np.cross(along, middle / np.linalg.norm(middle))
    axes = np.stack([across, along])
    inside = (seen_e.reshape(-1, 3) - middle) @ axes.T
    points = _along_the_ground(np.array([target.p_e for target in targets]), middle) @ axes.T
    low, high = np.nanmin(inside, axis=0), np.nanmax(inside, axis=0)
    lines = pushbroom_of(task).instants(np.array([0.0, task.strip.lines - 1.0]))
    speed_m_s = float(np.linalg.norm(last - first) / (lines[1] - lines[0]))
    return np.maximum(np.maximum(low - points, points - high), 0.0), speed_m_s


def _along_the_ground(p_e: Floats, middle_e: Floats) -> Floats:
    """Horizontal vectors (N, 3) from a point to places (N, 3), m, as long as the way along a sphere."""
    up = middle_e / np.linalg.norm(middle_e)
    level = p_e - np.outer(p_e @ up, up)
    length = np.linalg.norm(level, axis=1)
    way = np.linalg.norm(middle_e) * np.arctan2(length, p_e @ up)
    return np.asarray(level * (way / np.maximum(length, 1e-9))[:, None])
