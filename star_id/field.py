"""Attitude and camera of a single image of the sky: camera calibrated, field of view roughly known, or
unknown.

An unknown field of view is a series of nominal ones. For each, triangles are looked up in the table made for
it, large fields first, because their tables are small. The first nominal camera whose proposal passes the
test ends the search; all proposals of all nominal cameras count in its false-alarm probability. Given
centroid covariances, attitude and distortion are then fitted again with each star weighted by its own.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.star_camera import Projection, StarCamera
from boresight.records.record import Bools, Floats, Ints, array, inner, record, scalar
from boresight.star_id.beyond_chance import LEAST_STARS, LOST_BY_CHANCE
from boresight.star_id.common_variance import PER_PARAMETER
from boresight.star_id.field_fit import fit_attitude_and_lens
from boresight.star_id.field_match import match_field
from boresight.star_id.finding.star_list import StarList, list_stars
from boresight.star_id.fisheye import (
    FISHEYE_RAD,
    MIDDLE_TOLERANCE,
    WIDEST_RAD,
    is_wide_field,
    middle_field,
    middle_of,
    wide_lenses,
)
from boresight.star_id.given_camera import fit_known_camera
from boresight.star_id.identification.hypothesis import RESOLVED_PX, STARS_PER_DETECTION, robust_sigma
from boresight.star_id.identification.identify import (
    DENSER,
    FEW_DETECTIONS,
    SOME_DETECTIONS,
    USUAL,
    WIDER,
    Identification,
    NotIdentified,
    identify_stars,
    stages_of,
)
from boresight.star_id.identification.tangent_plane import FieldOfView
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.lens_model import CLEARLY_MORE, WIDE_RAD
from boresight.star_id.observer import ABERRATION_SCALE, Observer, proper_motion_covariance, star_directions
from boresight.star_id.settings import StarSettings
from boresight.star_id.sight import explained, field_of_camera, select_for_calibration, tangent_coordinates

__all__ = [
    "LARGEST_FOV_RAD",
    "SMALLEST_FOV_RAD",
    "FieldSolution",
    "nominal_camera",
    "ra_dec_roll",
    "solve_field",
    "solve_list",
    "solve_stars",
]

# Fields of view along x, rad, between which a camera is looked for that nothing is known of. Narrower ones
# hold fewer than some 20 stars of the bundled catalogue to V 8.
SMALLEST_FOV_RAD, LARGEST_FOV_RAD = np.radians(5.0), np.radians(60.0)
# Pixel size, m, of a camera made up for an image: only the ratio of focal length and pixel matters.
_NOMINAL_PIXEL_M = 5e-6
# Largest relative error of the nominal fields of view that are tried one after another.
_FOV_STEP = 0.10
# Largest relative change of a triangle's shape that an error of the nominal focal length may cause; it
# makes the steps of wide fields smaller than `_FOV_STEP` (set by hand).
_SHAPE_STEP = 0.012
# Stages of three passes over all fields of view, each a tuple of stages: the few
# brightest detections first, which name most images; then more of them; last the dense table, should many
# stars be missing (set by hand).
_FIRST, *_LATER = _PASSES = (
    stages_of(USUAL, FEW_DETECTIONS),
    (*stages_of(USUAL, SOME_DETECTIONS, begin=FEW_DETECTIONS), *stages_of(WIDER, FEW_DETECTIONS)),
    stages_of(DENSER, FEW_DETECTIONS, SOME_DETECTIONS),
)
_Attempt = tuple[bool, tuple[tuple[tuple[int, int, int], ...], ...], Projection]
# Attempts at an image, until one succeeds: (whether as a mirror image, passes, projection). Of an unknown
# camera the first pass, the first pass mirrored, then the others.
_ATTEMPTS: tuple[_Attempt, ...] = (
    (False, (_FIRST,), "tangent"),
    (True, (_FIRST,), "tangent"),
    (False, tuple(_LATER), "tangent"),
)
# The same of a camera that is known.
_ATTEMPTS_OF_CAMERA: tuple[_Attempt, ...] = ((False, _PASSES, "tangent"), (True, _PASSES, "tangent"))
# Error of detections and of predicted stars along one axis, px, in naming the stars outside the middle of a
# fisheye's image (set by hand).
_EXTENDED_PX = 0.5
# Ratio of identified stars above which kinds of lenses are compared by their residuals (set by hand).
_NEARLY_AS_MANY = 0.98


@record(kw_only=True)
class FieldSolution:
    """An identified image. Row n of the (M,) arrays is the same star."""

    R_si: Rotation = scalar("rotation GCRS to star-camera frame s")
    cov_s: Floats | None = scalar(
        "(3, 3) of a rotation of the image's centre about axes s, rad^2; None without centroid covariances"
    )
    camera: StarCamera = scalar("as given, or fitted to this image")
    fov_x_sigma_rad: float = scalar("of a fitted camera, rad; 0 if given, NaN without centroid covariances")
    hip: Ints = array("M", "Hipparcos numbers")
    rows: Ints = array("M", "rows of the index")
    detections: Ints = array("M", "rows of the centroids handed over")
    xy_px: Floats = array("M, 2", "centroids as (column, row)")
    u_i: Floats = array("M, 3", "directions, GCRS axes; apparent if there is an observer")
    false_alarm_probability: float = scalar("upper bound, over all proposals tried")
    log_false_alarm_probability: float = scalar("its natural logarithm")
    stars: StarList | None = scalar("all detections, if the image itself or a star list was given")
    misfit_px: float = scalar(
        "rms displacement of stars from the camera's model, an axis, px; 0: none seen", default=0.0
    )
    mirrored: bool = scalar(
        "whether the image is a mirror image: all else holds for it with the columns reversed", default=False
    )
    matches = inner[int]("hip", "number of identified stars", of=len)
    ra_rad = inner[float](
        "_ra_dec_roll_rad",
        "right ascension of the image's centre, GCRS axes; aberration is removed if there is an observer",
        of=itemgetter(0),
    )
    dec_rad = inner[float]("_ra_dec_roll_rad", "declination of the image's centre", of=itemgetter(1))
    roll_rad = inner[float](
        "_ra_dec_roll_rad",
        "position angle, east of north, of the image's up direction (towards row 0) at its centre",
        of=itemgetter(2),
    )
    fov_x_rad = inner[float]("camera.fov_x_rad", "angle between the middles of the left and right edges")

    @property
    def residual_px(self) -> Floats:
        """(M, 2) measured minus predicted pixels."""
        return self.xy_px - self.camera.pixels_from_directions(self.R_si.apply(self.u_i))

    @property
    def _ra_dec_roll_rad(self) -> tuple[float, float, float]:
        return ra_dec_roll(self.camera, self.R_si)

    @property
    def pointing_sigma_rad(self) -> float:
        """1-sigma error of the direction of the image's centre along one axis; NaN if `cov_s` is None."""
        return float(np.sqrt(0.5 * np.trace(self._centre_covariance()[:2, :2])))

    @property
    def roll_sigma_rad(self) -> float:
        """1-sigma error of the rotation about the direction of the image's centre; NaN if `cov_s` is None."""
        return float(np.sqrt(self._centre_covariance()[2, 2]))

    @property
    def rms_arcsec(self) -> float:
        """Root mean square distance of the identified stars from their predicted positions."""
        scale = self.camera.pixel_m / self.camera.focal_m / ARCSEC
        return float(np.sqrt((self.residual_px**2).sum(axis=1).mean()) * scale)

    def _centre_covariance(self) -> Floats:
        """(3, 3) rad^2, of a rotation about right, down and the direction of the image's centre."""
        if self.cov_s is None:
            return np.full((3, 3), np.nan)
        axes = self.camera.middle_axes()
        return np.asarray(axes.T @ self.cov_s @ axes)


@record(kw_only=True)
class _Known:
    """What is known of an image beside its detections."""

    size: tuple[int, int] = scalar("width and height, px")
    index: StarIndex = scalar("stars and triangles")
    settings: StarSettings = scalar("of identification")
    camera: StarCamera | None = scalar("calibrated camera; None: fitted")
    fov_x_rad: float | None = scalar("field of view along the columns' direction; None: unknown")
    observer: Observer | None = scalar("place and time; None: unknown")

    def covariance(self, rows: Ints, camera: StarCamera, R_si: Rotation) -> Floats:
        """Covariances (N, 2, 2), px^2, of the places of catalogue stars (N,) in an image without time."""
        years = self.settings.epoch_error_years if self.observer is None else 0.0
        return proper_motion_covariance(self.index, rows, camera, R_si, years)


def ra_dec_roll(camera: StarCamera, R_si: Rotation) -> tuple[float, float, float]:
    """Right ascension and declination of an image's centre, and the position angle, east of north, of its up
    direction (towards row 0) there; rad, GCRS axes."""
    axes_i = R_si.as_matrix().T @ camera.middle_axes()
    (_, x_down, x), (_, y_down, y), (_, _, z) = axes_i.tolist()
    ra, dec = math.atan2(y, x) % (2.0 * math.pi), math.asin(min(max(z, -1.0), 1.0))
    # east is (-y, x, 0), and north, the centre times east, has the component z of down over its length
    return ra, dec, math.atan2(y * x_down - x * y_down, -float(axes_i[2, 1]))


def solve_field(
    image: NDArray[Any],
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
    dark: NDArray[Any] | None = None,
    observer: Observer | None = None,
) -> FieldSolution | NotIdentified:
    """Attitude, camera and identified stars of a raw image.

    Parameters
    ----------
    image : (H, W) array
        Raw image, 8 or 16 bits or floating.
    index : StarIndex
        Star index that covers the field of view (`build_index`).
    settings : StarSettings
        Detection and identification.
    camera : StarCamera, optional
        Calibrated camera. Without it focal length and distortion are fitted.
    fov_x_rad : float, optional
        Field of view along the columns' direction, good to `settings.fov_tolerance`. Without it and without
        a camera, 5 to 60 degrees are tried.
    dark : (H, W) array, optional
        Dark frame of the camera.
    observer : Observer, optional
        Place and time of the image; aberration and refraction are then taken into account.

    Returns
    -------
    FieldSolution or NotIdentified

    Raises
    ------
    ValueError
        If the image is not (H, W) of at least 32 pixels, or the dark frame has another size.
    """
    stars = list_stars(image, settings, dark)
    size = (image.shape[1], image.shape[0])
    found = solve_list(stars, size, index, settings, camera=camera, fov_x_rad=fov_x_rad, observer=observer)
    return explained(found, image, stars.saturation_dn) if isinstance(found, NotIdentified) else found


def solve_list(
    stars: StarList,
    size: tuple[int, int],
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
    observer: Observer | None = None,
) -> FieldSolution | NotIdentified:
    """Solution as in `solve_field`, from the stars found in an image of `size` (width, height), px."""
    known = _Known(
        size=size, index=index, settings=settings, camera=camera, fov_x_rad=fov_x_rad, observer=observer
    )
    if camera is None and fov_x_rad is not None and fov_x_rad >= FISHEYE_RAD:
        return _of_fisheye(stars, known, fov_x_rad)
    attempts = _ATTEMPTS if camera is None else _ATTEMPTS_OF_CAMERA
    if camera is None and fov_x_rad is not None and fov_x_rad > WIDE_RAD:
        attempts = (*attempts, (False, _PASSES, "equidistant"))
    view = cache(lambda mirrored: stars.mirrored(size[0]) if mirrored else stars)
    tried, reasons, best = 0, [], None
    likeliest_first = _likeliest_first(stars)
    for mirrored, passes, projection in attempts:
        if best is not None and projection == "tangent":
            continue
        seen = view(mirrored)
        answer = _identified(seen.xy_px[likeliest_first], known, passes, tried, projection)
        if isinstance(answer, NotIdentified):
            tried = answer.proposals
            reasons.append(answer)
            continue
        found = replace(answer[0], detections=likeliest_first[answer[0].detections])
        if camera:
            solution: FieldSolution | None = _of_known_camera(seen, found, known, camera)
        else:
            of_lens = seen, found, answer[1], known
            solution = _fitted(*of_lens, first=None) or _fitted(*of_lens)
        if solution is None:
            reasons.append(_without_lens(found))
        elif best is None or solution.matches > CLEARLY_MORE * best.matches:
            best, named = replace(solution, mirrored=True) if mirrored else solution, found
    if best is None:
        return max(reasons, key=lambda answer: answer.best_log_odds)
    if camera is None and best.fov_x_rad > WIDE_RAD:
        return _of_likelier_projection(best, named, view(best.mirrored), known)
    return best


def _likeliest_first(stars: StarList) -> Ints:
    """Rows of the stars by the better of their ranks by flux and by signal-to-noise ratio: leaves and roofs
    are bright and noisy, nebulae hide what is bright."""
    by_snr = np.empty(len(stars.snr), dtype=np.int64)
    by_snr[np.argsort(-stars.snr, kind="stable")] = np.arange(len(stars.snr))
    return np.argsort(np.minimum(by_snr, np.arange(len(by_snr))), kind="stable")


def _of_likelier_projection(
    best: FieldSolution, named: Identification, stars: StarList, known: _Known
) -> FieldSolution:
    """The solution, or that of the other projection from the same stars if it leaves smaller residuals: the
    projection by which the stars were named need not be the lens's own."""
    other: Projection = "tangent" if best.camera.projection == "equidistant" else "equidistant"
    start = nominal_camera(known.size, best.fov_x_rad, other)
    found = replace(named, detections=best.detections, stars=best.rows, R_si=best.R_si)
    solution = _fitted(stars, found, start, known)
    if solution is None:
        return best
    return _likeliest([best, replace(solution, mirrored=best.mirrored)], stars)


def _likeliest(every: Sequence[FieldSolution], stars: StarList) -> FieldSolution:
    """The lens that, of those with nearly as many stars as the one with most, leaves the smallest residuals
    of that one's stars; the first, unless others are clearly better."""
    best = max(every, key=lambda lens: lens.matches)
    lenses = [lens for lens in every if lens.matches >= _NEARLY_AS_MANY * best.matches]
    W = np.linalg.inv(stars.cov_px[best.detections])

    def misfit(lens: FieldSolution) -> float:
        residual = best.xy_px - lens.camera.pixels_from_directions(lens.R_si.apply(best.u_i))
        square = np.einsum("mi,mij,mj->m", residual, W, residual)
        return float(np.fmin(0.5 * np.nan_to_num(square, nan=np.inf), -np.log(LOST_BY_CHANCE)).sum())

    # lenses that explain the stars alike have misfits that rounding orders
    return min(lenses, key=lambda lens: misfit(lens) - (PER_PARAMETER if lens is lenses[0] else 0.0))


def _of_fisheye(stars: StarList, known: _Known, fov_x_rad: float) -> FieldSolution | NotIdentified:
    """Solution by the middle of the image, and from there outwards with each kind of lens (`fisheye`)."""
    if fov_x_rad > (1.0 + 1e-9) * WIDEST_RAD:  # that of a nominal camera is rounded
        widest = f"fields of view are at most {np.degrees(WIDEST_RAD):.0f} deg along columns"
        reason = (
            f"{widest}: a camera here has no directions 90 deg from its axis; state that, or crop the image"
        )
        return NotIdentified(reason, len(stars.snr))
    wide, tried, reasons = replace(known.settings, fov_tolerance=MIDDLE_TOLERANCE), 0, []
    for mirrored in (False, True):
        seen = stars.mirrored(known.size[0]) if mirrored else stars
        middle = middle_of(seen.xy_px, known.size, fov_x_rad)
        of_middle = replace(known, size=middle.size, settings=wide, fov_x_rad=middle.fov_rad)
        answer = _identified(middle.xy_px, of_middle, _PASSES, tried, "equidistant")
        if isinstance(answer, NotIdentified):
            tried = answer.proposals
            reasons.append(replace(answer, reason=f"in the middle of the image {answer.reason}"))
            continue
        named = replace(answer[0], detections=middle.rows[answer[0].detections])
        whole = nominal_camera(known.size, fov_x_rad, "equidistant")
        kinds = wide_lenses(replace(whole, focal_m=answer[1].focal_m, pixel_m=answer[1].pixel_m))
        for first in (SOME_DETECTIONS, len(named.detections)):  # a false one among few may be in the way
            fits = (_fitted(seen, named, kind, known, expected=kind, first=first) for kind in kinds)
            lenses = [
                replace(fit, mirrored=mirrored)
                for fit in fits
                if fit is not None and fit.matches >= len(named.detections)
            ]
            if not lenses:
                continue
            return _likeliest(lenses, seen)
        reasons.append(_without_lens(named))
    return max(reasons, key=lambda answer: answer.best_log_odds)


def _without_lens(found: Identification) -> NotIdentified:
    n, odds = len(found.stars), -found.log_false_alarm_probability
    return NotIdentified(f"{n} stars identified, but no lens fits them", n, found.proposals, odds)


def _of_known_camera(
    stars: StarList, found: Identification, known: _Known, camera: StarCamera
) -> FieldSolution:
    """Solution of a calibrated camera, each star weighted by its own covariance."""
    rows, index = found.detections, known.index
    cov = stars.cov_px.take(rows, axis=0) + known.covariance(found.stars, camera, found.R_si)
    xy, u_i = stars.xy_px.take(rows, axis=0), star_directions(index, found.stars, known.observer)
    used = select_for_calibration(stars.centroids, rows, found.stars, camera, index, known.settings)
    fitted = xy, cov, u_i
    if LEAST_STARS <= np.count_nonzero(used) < len(used):
        fitted = xy[used], cov[used], u_i[used]
    fit = fit_known_camera(camera, *fitted, found.R_si)
    measured = {"R_si": fit.R_si, "cov_s": fit.cov_s, "misfit_px": fit.misfit_px, "u_i": u_i}
    return _solution(found, stars.xy_px, camera, index, fov_x_sigma_rad=0.0, stars=stars, **measured)


def _fitted(
    stars: StarList,
    found: Identification,
    start: StarCamera,
    known: _Known,
    expected: StarCamera | None = None,
    first: int | None = SOME_DETECTIONS,
) -> FieldSolution | None:
    """Solution with attitude, lens and matches in turn, each star weighted by its own covariance: the `first`
    brightest stars fit the lens, the lens tells which detections are further stars, until they no longer
    change; None where they become too few, or no lens fits them.

    With None for `first` all detections that match a star by the lens `start` fit the lens once, and must be
    those that match by the fitted one, else None: wrong ones, as off its middle, could confirm themselves.
    """
    detections, rows = found.detections[:first], found.stars[:first]
    camera, R_si, index, observer = start, found.R_si, known.index, known.observer
    shown = _expected_stars(start, R_si, len(stars.xy_px), index)
    u_i, moved = star_directions(index, shown, observer), known.covariance(shown, start, R_si)

    def matched(predicted_px: Floats, cov_px: Floats) -> tuple[Ints, Ints]:
        seen, area_px = np.flatnonzero(start.contains(predicted_px)), start.width_px * start.height_px
        places = predicted_px[seen], (cov_px + moved)[seen]
        match = match_field(stars.xy_px, stars.cov_px, *places, area_px)
        return match.detections, shown[seen[match.stars]]

    if first is None:
        u_found = star_directions(index, rows, observer)
        off = stars.xy_px[detections] - start.pixels_from_directions(R_si.apply(u_found))
        error2 = robust_sigma(2.0 * np.hypot(*off.T), pixel=1.0) ** 2 * np.eye(2)  # the fit decides at limits
        detections, rows = matched(start.pixels_from_directions(R_si.apply(u_i)), error2)
    for _ in range(30 if first else 1):  # matching stars and fitting the lens in turn
        reliable = _if_enough(
            select_for_calibration(stars.centroids, detections, rows, start, index, known.settings)
        )
        xy, cov = stars.xy_px[detections[reliable]], stars.cov_px[detections[reliable]]
        cov = cov + known.covariance(rows[reliable], start, R_si)
        try:
            fit = fit_attitude_and_lens(
                camera, R_si, xy, cov, star_directions(index, rows[reliable], observer), expected
            )
        except np.linalg.LinAlgError:  # a lens of another projection
            return None
        camera, R_si = fit.errors.camera, fit.R_si
        before, (detections, rows) = rows, matched(*fit.predict(u_i))
        if len(rows) < LEAST_STARS:
            return None
        if np.array_equal(rows, before):
            break
        if first is None:
            return None
    timeless = known.settings.epoch_error_years > 0.0 and observer is None
    unknown_scale = np.hypot(ABERRATION_SCALE if timeless else 0.0, stars.psf.scale_sigma)
    field = fit.field
    return _solution(
        replace(found, detections=detections, stars=rows, R_si=R_si),
        stars.xy_px,
        camera,
        index,
        cov_s=field.cov_s,
        fov_x_sigma_rad=float(np.hypot(field.fov_x_sigma_rad, unknown_scale * camera.fov_x_rad)),
        misfit_px=field.misfit_px,
        u_i=star_directions(index, rows, observer),
        stars=stars,
    )


def _expected_stars(camera: StarCamera, R_si: Rotation, detections: int, index: StarIndex) -> Ints:
    """Rows of the stars that so many detections can show, in the image or just outside, brightest first."""
    rows = index.near(R_si.as_matrix()[2], 1.05 * camera.field_radius_rad)
    rows = rows[index.to_brighter_rad[rows] > RESOLVED_PX * camera.pixel_m / camera.focal_m]
    xy = camera.pixels_from_directions(R_si.apply(index.u_i[rows]))
    with np.errstate(invalid="ignore"):
        inside = camera.contains(xy)
    return np.asarray(rows[inside][: int(STARS_PER_DETECTION * detections) + 12])


def _if_enough(reliable: Bools) -> Bools:
    """(N,) the stars to measure by: the reliable ones; all, where too few are."""
    return reliable if reliable.sum() >= LEAST_STARS else np.ones(len(reliable), dtype=bool)


def solve_stars(
    xy_px: Floats,
    size: tuple[int, int],
    index: StarIndex,
    settings: StarSettings,
    *,
    camera: StarCamera | None = None,
    fov_x_rad: float | None = None,
) -> FieldSolution | NotIdentified:
    """Solution from pixel positions (N, 2) alone, brightest first, in an image of `size` (width, height), px.

    All stars have equal weights and the solution no covariance; other arguments as in `solve_field`.
    """
    known = _Known(
        size=size, index=index, settings=settings, camera=camera, fov_x_rad=fov_x_rad, observer=None
    )
    answer = _identified(xy_px, known)
    return answer if isinstance(answer, NotIdentified) else _solution(answer[0], xy_px, answer[1], index)


def _identified(
    xy_px: Floats,
    known: _Known,
    passes: tuple[tuple[tuple[int, int, int], ...], ...] = _PASSES,
    tried: int = 0,
    projection: Projection = "tangent",
) -> tuple[Identification, StarCamera] | NotIdentified:
    """The identification, and the camera, given or fitted, that it holds for."""
    camera, index, settings = known.camera, known.index, known.settings
    if camera is not None:
        plane, field = tangent_coordinates(camera, xy_px), field_of_camera(camera, settings)
        seen = None
        if is_wide := is_wide_field(field):
            field, seen = middle_field(field, plane, camera.focal_m / camera.pixel_m)
            plane = plane[seen]
        elif not math.isfinite(plane.sum()):  # beyond a turning point there is no direction
            seen = np.flatnonzero(np.isfinite(plane).all(axis=1))
            plane = plane[seen]
        found = identify_stars(plane, field, index, settings, tried=tried)
        if isinstance(found, NotIdentified):
            return found
        found = found if seen is None else replace(found, detections=seen[found.detections])
        return (_extended(found, xy_px, camera, index, settings) if is_wide else found), camera
    best, likeliest = -np.inf, None
    fields = _fields_to_try(known.fov_x_rad, settings)
    for stages in passes:
        for (fov, error), (below, _) in pairwise([*fields, (0.0, 0.0)]):
            nominal = nominal_camera(known.size, fov, projection)
            plane, field = tangent_coordinates(nominal, xy_px), _nominal_field(nominal, error, fov, settings)
            found = identify_stars(plane, field, index, settings, stages=stages, tried=tried)
            tried = max(found.proposals, tried)
            if isinstance(found, NotIdentified):
                best = max(best, found.best_log_odds)
            elif likeliest is None or (
                found.log_false_alarm_probability < likeliest[0].log_false_alarm_probability
            ):
                likeliest = found, _fitted_camera(nominal, found.distortion)
            # at the edge of what a nominal field covers some stars are named wrongly: the next one is nearer
            if likeliest is not None and likeliest[1].fov_x_rad >= np.sqrt(fov * below):
                return likeliest
        if likeliest is not None:
            return likeliest
    low, high = np.degrees(fields[-1][0]), np.degrees(fields[0][0])
    return NotIdentified(
        f"{len(xy_px)} stars found; {tried} triangles agree with the catalogue for fields of view from"
        f" {low:.1f} to {high:.1f} deg, none explains the image",
        len(xy_px),
        tried,
        best,
    )


def _extended(
    found: Identification, xy_px: Floats, camera: StarCamera, index: StarIndex, settings: StarSettings
) -> Identification:
    """The identification of the middle of an image, with the stars of the whole image by a known camera."""
    rows = _expected_stars(camera, found.R_si, len(xy_px), index)
    predicted = camera.pixels_from_directions(found.R_si.apply(index.u_i[rows]))
    off = np.hypot(*(predicted - 0.5 * (np.array([camera.width_px, camera.height_px]) - 1.0)).T)
    error2 = _EXTENDED_PX**2 + (settings.camera_error * off) ** 2
    same = np.broadcast_to(_EXTENDED_PX**2 * np.eye(2), (len(xy_px), 2, 2))
    area_px = camera.width_px * camera.height_px
    match = match_field(xy_px, same, predicted, error2[:, None, None] * np.eye(2), area_px)
    if len(match.stars) < len(found.stars):
        return found
    return replace(found, detections=match.detections, stars=rows[match.stars])


def nominal_camera(size: tuple[int, int], fov_x_rad: float, projection: Projection = "tangent") -> StarCamera:
    """Camera without distortion for images of `size` (width, height) and a field of view along the columns'
    direction, rad."""
    width, height = size
    half = 0.5 * fov_x_rad if projection == "equidistant" else np.tan(0.5 * fov_x_rad)
    focal_px = 0.5 * width / half
    middle = (0.5 * (width - 1), 0.5 * (height - 1))
    return StarCamera(
        focal_m=float(focal_px * _NOMINAL_PIXEL_M),
        pixel_m=_NOMINAL_PIXEL_M,
        width_px=width,
        height_px=height,
        principal_px=middle,
        projection=projection,
    )


def _fields_to_try(fov_x_rad: float | None, settings: StarSettings) -> list[tuple[float, float]]:
    """Nominal fields of view (rad), largest first, each with the relative error that it covers."""
    if fov_x_rad is None:
        low, high = SMALLEST_FOV_RAD, LARGEST_FOV_RAD
    else:
        low, high = fov_x_rad * (1 - settings.fov_tolerance), fov_x_rad * (1 + settings.fov_tolerance)
    fields = []
    top = high * 1.001
    while top > low:
        error = min(_FOV_STEP, _SHAPE_STEP / (0.6 * top) ** 2)
        nominal = max(top / (1 + error), np.sqrt(low * top))
        fields.append((float(nominal), float(error)))
        top = nominal / (1 + error)
    return fields


def _nominal_field(nominal: StarCamera, error: float, fov: float, settings: StarSettings) -> FieldOfView:
    """Field of view of a nominal camera, with the errors that distortion and an error of `fov` cause."""
    shape = settings.uncalibrated_error * min(1.0, 0.3 + fov / np.radians(40.0))
    return replace(field_of_camera(nominal, settings), scale_error=error + 0.02, shape_error=shape)


def _fitted_camera(nominal: StarCamera, distortion: Floats) -> StarCamera:
    """The nominal camera with the log scale, k1, p1 and p2 that identification fitted in the tangent
    plane."""
    log_scale, k1, p1, p2 = distortion.tolist()
    focal_m = nominal.focal_m * float(np.exp(log_scale))
    f_mm = focal_m * 1e3
    return replace(nominal, focal_m=focal_m, p1=-p1 / f_mm, p2=-p2 / f_mm, q1=k1 / f_mm**2)


def _solution(
    found: Identification, xy_px: Floats, camera: StarCamera, index: StarIndex, **measured: Any
) -> FieldSolution:
    """Solution of an identification; `measured` are its fields that a fit gave."""
    fields: dict[str, Any] = {
        "R_si": found.R_si,
        "cov_s": None,
        "camera": camera,
        "fov_x_sigma_rad": np.nan,
        "hip": index.stars.hip.take(found.stars),
        "rows": found.stars,
        "detections": found.detections,
        "xy_px": xy_px.take(found.detections, axis=0),
        "u_i": index.u_i.take(found.stars, axis=0),
        "false_alarm_probability": found.false_alarm_probability,
        "log_false_alarm_probability": found.log_false_alarm_probability,
        "stars": None,
    }
    return FieldSolution(**(fields | measured))
