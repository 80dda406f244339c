"""Errors of a result against the truth of a simulated dump: of the matrix, and of ground points.

This is the only module that opens a dump's `truth/` folder.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial.transform import Rotation

from boresight.geometry.geodesy import ecef_from_geodetic, local_axes_e, unit_vectors
from boresight.geometry.installation import theta_between
from boresight.geometry.pushbroom import Pushbroom
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.files.text_files import read_table, read_toml
from boresight.pipeline.results import strip_model
from boresight.pipeline.results.check_point_test import DIRECTIONS, RmsTest, rms_test
from boresight.pipeline.results.place_errors import PassErrors, PlaceErrors, covariance_of_places
from boresight.pipeline.results.reading import SavedResult
from boresight.records.record import Floats, Texts, array, record, scalar

__all__ = ["CheckPoints", "TruthErrors", "true_installation", "validation_of"]


class TrueInstallationFile(BaseModel):
    """truth/installation.toml"""

    model_config = ConfigDict(extra="ignore", strict=True, allow_inf_nan=False, frozen=True)
    quaternion_cs: Annotated[list[float], Field(min_length=4, max_length=4)]


class CheckPointRow(BaseModel):
    """truth/check_points.csv: true ground point of a pixel (height above WGS84)."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)
    id: str
    strip: str
    ccd: int
    sample: float
    line: float
    lat_deg: float
    lon_deg: float
    height_m: float


@record(kw_only=True)
class CheckPoints:
    """Geo-positioning errors, computed minus true, at N check points, in the horizontal plane."""

    strip_id: Texts = array("N", "strip of each check point")
    point_id: Texts = array("N", "its id")
    lat_deg: Floats = array("N", "true geodetic latitude")
    lon_deg: Floats = array("N", "true longitude")
    along_m: Floats = array("N", "along the satellite's motion relative to the ground")
    across_m: Floats = array("N", "to the right of it")
    up_m: Floats = array("N", "along the ellipsoid's normal")
    east_m: Floats = array("N", "to the east")
    north_m: Floats = array("N", "to the north")

    @property
    def rms_m(self) -> tuple[float, float]:
        """Root mean square along and across track."""
        return float(np.sqrt(np.mean(self.along_m**2))), float(np.sqrt(np.mean(self.across_m**2)))


@record(kw_only=True)
class TruthErrors:
    """Errors of a result, and of the matrix that it started from."""

    error_rad: Floats = array("3", "theta of the result's error: R_result = exp[[error]] R_true")
    sigma_rad: Floats = array("3", "1-sigma that the result states")
    nees: float = scalar("error_rad squared in the stated covariance: chi-square of 3 dof")
    before_rad: Floats = array("3", "error of the pre-launch matrix")
    after: CheckPoints = scalar("with the result's matrix")
    before: CheckPoints = scalar("with the pre-launch matrix")
    predicted: tuple[RmsTest, ...] = scalar("errors of check points against those that the result predicts")
    without: int = scalar("check points without attitude or ground, for which no error can be given")


def validation_of(result: SavedResult, dump: Dump) -> TruthErrors:
    """Errors of `result` against the truth of `dump`. `RawDataError` when the dump has no truth."""
    truth = dump.root / "truth"
    R_true = true_installation(dump)
    points = read_table(truth / "check_points.csv", CheckPointRow, "truth/check_points.csv")
    error = theta_between(result.R_cs, R_true)
    after, strips = _check(points, result, dump, result.R_cs)
    before, _ = _check(points, result, dump, dump.R_cs0)
    return TruthErrors(
        error_rad=error,
        sigma_rad=np.sqrt(np.diag(result.cov_theta)),
        nees=float(error @ np.linalg.solve(result.cov_theta, error)),
        before_rad=theta_between(dump.R_cs0, R_true),
        after=after,
        before=before,
        predicted=_against_prediction(after, strips, result, dump),
        without=len(points) - len(after.along_m),
    )


def true_installation(dump: Dump) -> Rotation:
    """True installation matrix of a simulated dump, star camera to remote-sensing camera."""
    path = dump.root / "truth" / "installation.toml"
    return Rotation.from_quat(read_toml(path, TrueInstallationFile, "truth/installation.toml").quaternion_cs)


def _check(
    points: list[CheckPointRow], result: SavedResult, dump: Dump, R_cs: Rotation
) -> tuple[CheckPoints, list[PlaceErrors]]:
    """Errors of the check points that have one, and what moves these, strip by strip."""
    strips = {strip.strip_id: strip for strip in dump.strips}
    for point in points:
        if not 0 <= point.ccd < dump.line_camera.n_ccds:
            raise RawDataError("truth/check_points.csv", "ccd", str(point.ccd), "a CCD of the camera")
    found: list[CheckPointRow] = []
    errors, moving = [], []
    for strip_id in sorted({point.strip for point in points} & strips.keys()):
        here, strip = [point for point in points if point.strip == strip_id], strips[strip_id]
        margin_s = strip_model.run_settings_of(result, "installation.json").exposure_margin_s
        near = strip_model.exposures_around(result, dump, strip, margin_s)
        if len(near) < 2:
            continue
        track = strip_model.attitude_track(result, dump, near)
        model = strip_model.pushbroom_with(track, strip, dump, R_cs)
        ccd, line = np.array([point.ccd for point in here]), np.array([point.line for point in here])
        instants, (first, last) = model.instants_of_lines(ccd, line).tolist(), track.span_s
        seen = [point for point, t in zip(here, instants) if first <= t <= last]
        if not seen:
            continue
        t_s, places_e = [], []
        for k in sorted({point.ccd for point in seen}):
            those = [point for point in seen if point.ccd == k]
            error, computed_e = _error(those, k, model, dump)
            good = np.asarray(np.isfinite(error).all(axis=1))
            errors.append(error[good])
            found += [point for point, known in zip(those, good.tolist()) if known]
            t_s.append(model.instants_of_lines(k, np.array([point.line for point in those])[good]))
            places_e.append(computed_e[good])
        of_pass = PassErrors.of(result, dump, strip, track, strip_model.terrain_sigma_m(dump))
        moving.append(of_pass.at(np.concatenate(t_s), np.concatenate(places_e)))
    along, across, up, east, north = np.vstack([np.zeros((0, 5)), *errors]).T
    checked = CheckPoints(
        strip_id=np.array([point.strip for point in found], dtype=str),
        point_id=np.array([point.id for point in found], dtype=str),
        lat_deg=np.array([point.lat_deg for point in found], dtype=float),
        lon_deg=np.array([point.lon_deg for point in found], dtype=float),
        along_m=along,
        across_m=across,
        up_m=up,
        east_m=east,
        north_m=north,
    )
    return checked, moving


def _against_prediction(
    after: CheckPoints, strips: list[PlaceErrors], result: SavedResult, dump: Dump
) -> tuple[RmsTest, ...]:
    """The errors along and across the track, tested; none without check points."""
    if not len(after.along_m):
        return ()
    covariance = covariance_of_places(strips, result, dump)
    errors = (after.along_m, after.across_m)
    return tuple(map(rms_test, DIRECTIONS, errors, covariance))


def _error(points: list[CheckPointRow], ccd: int, model: Pushbroom, dump: Dump) -> tuple[Floats, Floats]:
    """Computed minus true (N, 5): along track, across track, up, east, north, m; computed places (N, 3)."""
    rows = [(one.sample, one.line, one.lat_deg, one.lon_deg, one.height_m) for one in points]
    sample, line, lat_deg, lon_deg, height_m = np.array(rows).T.copy()
    lat, lon = np.radians(lat_deg), np.radians(lon_deg)
    true_e = ecef_from_geodetic(lat, lon, height_m)
    computed_e = model.ground_points(ccd, sample, line, surface_of(dump.terrain))
    up = unit_vectors(lon, lat)
    motion = dump.orbit.velocities_e(model.instants_of_lines(ccd, line))
    along = motion - up * np.einsum("ni,ni->n", motion, up)[:, None]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    right = np.cross(along, up)
    difference = computed_e - true_e
    east, north, _ = np.moveaxis(local_axes_e(lat, lon), 2, 0)
    axes = (along, right, up, east, north)
    return np.column_stack([np.einsum("ni,ni->n", difference, axis) for axis in axes]), computed_e
