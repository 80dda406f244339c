"""Motion of the installation matrix between the results of several dumps: read, checked to be of one pair of
cameras, estimated. `report.drift` writes the files.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs
from boresight.features.drift.matrix_drift import Drift, DriftSettings, MountingSeries, estimate_drift
from boresight.geometry.constants import ARCSEC, DAY_S
from boresight.geometry.epoch import Epoch
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.record import record, scalar
from boresight.pipeline import __version__
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.table_files import column
from boresight.pipeline.files.text_files import read_json
from boresight.pipeline.results.folder import results_in
from boresight.pipeline.results.reading import read_mounting, read_saved_result
from boresight.pipeline.results.sightings_tables import read_sightings

__all__ = [
    "DatedDrift",
    "drift_json",
    "drift_of_results",
    "drift_summary",
    "drift_table",
    "drift_verdict",
    "named_results",
    "step_dates",
]

Array = NDArray[np.float64]
AXES = ("X", "Y", "Z")  # of frame c, as tables name them
# By which the unknowns of the distortion are measured.
OF_DISTORTION = (
    *("sigma_distortion_rad", "distortion_length_px", "distortion_pixel_rad"),
    *("sigma_ccd_shift_rad", "sigma_ccd_slope_rad", "sigma_ccd_bend_rad", "ccd_px"),
)
BY_CAMERA = ("mission", "star_camera", "remote_camera")  # of evidence/context.json: alike in all results


@record
class DatedDrift:
    """A drift, with the epoch of its times and the pre-launch matrix to which its angles refer."""

    drift: Drift = scalar("estimate of the drift")
    epoch: Epoch = scalar("zero of the series' t_s")
    R_cs0: Rotation = scalar("pre-launch matrix of the earliest result")


@dataclass(frozen=True, slots=True, eq=False)
class _DatedResult:
    name: str
    pair: InformationPairs  # of theta and of the camera's distortion
    R_cs0: Rotation
    utc: tuple[str, ...]  # of its strips
    cos_sin: Array  # (2,) mean over the strips
    alike: dict[str, Any]  # what must be the same in all results, where it is known


def named_results(folders: Sequence[Path]) -> dict[str, Path]:
    """The results that are meant by folders: themselves, or those of their dumps. `RawDataError` for one that
    is named twice.
    """
    named: dict[Path, Path] = {}
    for folder in folders:
        for path in results_in(folder):
            if (real := path.resolve()) in named:
                raise RawDataError(
                    str(path), "RESULT", f"the same folder as {named[real]}", "each result once"
                )
            named[real] = path
    return {str(path): path for path in named.values()}


def drift_of_results(results: Mapping[str, Path], settings: DriftSettings) -> DatedDrift:
    """The course of the mounting that finished results speak of, each by its name, in whatever order.

    `RawDataError` for a result that cannot be read or is not of the same cameras as the first;
    `DataNotSufficientError` when the results do not make a series.
    """
    read = [_read(name, path) for name, path in results.items()]
    for other in read[1:]:
        _check_alike(read[0], other)
    if len(read) < 2:
        raise DataNotSufficientError(f"{len(read)} results show no course of time, 2 are needed")
    epoch = Epoch.from_utc(min(utc for result in read for utc in result.utc))
    dated = sorted(((float(epoch.seconds_from_utc(r.utc).mean()), r) for r in read), key=lambda item: item[0])
    pairs = reduce(InformationPairs.merged, [result.pair for _, result in dated])
    try:
        series = MountingSeries.of(
            pairs,
            prior_information(pairs.shared),
            np.array([t_s for t_s, _ in dated]),
            np.array([result.cos_sin for _, result in dated]),
        )
        found = estimate_drift(series, settings)
    except ValueError as error:
        raise DataNotSufficientError(str(error)) from error
    return DatedDrift(found, epoch, dated[0][1].R_cs0)


def drift_table(dated: DatedDrift) -> pd.DataFrame:
    """One row a result and axis; angles in arcsec against the merged matrix, frame c, with their 1-sigma as
    such: what all results share is in both and falls out.
    """
    drift, series = dated.drift, dated.drift.series
    phase = np.degrees(np.arctan2(series.cos_sin[:, 1], series.cos_sin[:, 0])) % 360.0
    sigma, smoothed_sigma = (
        np.sqrt(np.maximum(np.einsum("kii->ki", covariance - drift.merged.covariance), 0.0)) / ARCSEC
        for covariance in (series.covariance, drift.walk.covariance)
    )
    rows = [
        (
            name,
            utc,
            axis,
            series.theta[k, a] / ARCSEC,
            sigma[k, a],
            drift.walk.theta[k, a] / ARCSEC,
            smoothed_sigma[k, a],
            phase[k],
        )
        for k, (name, utc) in enumerate(zip(series.names, _dates(dated.epoch, series.t_s)))
        for a, axis in enumerate(AXES)
    ]
    names = ["result", "utc", "axis", "theta_arcsec", "sigma_arcsec", "smoothed_arcsec"]
    return pd.DataFrame(rows, columns=[*names, "smoothed_sigma_arcsec", "argument_of_latitude_deg"])


def drift_summary(dated: DatedDrift) -> str:
    """Lines for the terminal: span, merged 1-sigma, and each model of the drift with its test."""
    drift = dated.drift
    first, *_, last = _dates(dated.epoch, drift.series.t_s)
    sigma = np.sqrt(np.diag(drift.merged.covariance)) / ARCSEC
    rest, walk = drift.constant, drift.walk
    lines = [
        f"{len(drift.series.names)} results from {first[:10]} to {last[:10]}",
        "merged 1 sigma, arcsec    " + "".join(f"{s:14.4f}" for s in sigma),
        f"against one constant      chi2 / dof {rest.chi2:.1f} / {rest.dof}, p {rest.p_value:.3g}",
        f"best step                 chi2 falls by {drift.step.gain:.1f}, p {drift.step.p_value:.3g}",
        f"random walk               {_per_root_day(walk.density_rad2_s):.4g} arcsec per root day"
        + (f", {_interval(drift)}" if walk.estimated else ", as given"),
    ]
    if (term := drift.orbit_phase) is not None:
        size = np.hypot(term.cosine, term.sine) / ARCSEC
        lines.append(
            "orbit term, arcsec        " + "".join(f"{s:14.4f}" for s in size) + f"  p {term.p_value:.2g}"
        )
    lines.append(drift_verdict(dated))
    if drift.moved:
        date, low, high = step_dates(dated)
        step = drift.step.theta_step / ARCSEC
        step_sigma = np.sqrt(np.diag(drift.step.covariance)) / ARCSEC
        lines += [
            f"as one step: {date[:10]}, {drift.settings.confidence:.0%} between {low[:10]} and {high[:10]}",
            "  theta, arcsec           " + "".join(f"{s:+14.4f}" for s in step),
            "  1 sigma, arcsec         " + "".join(f"{s:14.4f}" for s in step_sigma),
        ]
    return "\n".join(lines)


def _read(name: str, path: Path) -> _DatedResult:
    saved = read_saved_result(path)
    R_cs0 = deviation_from_theta(saved.theta).inv() * saved.R_cs
    pair = read_mounting(path, name)
    alike: dict[str, Any] = {}
    context = _context(path)
    alike |= {key: context[key] for key in BY_CAMERA if key in context}
    if pair.shared:
        stated = saved.installation.get("settings", {}).get("calibration", {})
        alike |= {f"settings.calibration.{key}": stated.get(key) for key in OF_DISTORTION}
    table = read_sightings(path, "passes", "utc_middle argument_of_latitude_rad camera")
    utc = tuple(table.column("utc_middle").to_pylist())
    u = column(table, "argument_of_latitude_rad")
    try:
        Epoch.from_utc(min(utc)).seconds_from_utc(utc)
    except ValueError as error:
        file = str(path / "sightings" / "passes.parquet")
        raise RawDataError(file, "utc_middle", str(error), "UTC times of strips") from error
    # A digest is only comparable between results of one version of the program.
    alike[f"camera of version {saved.installation.get('version')}"] = sorted(
        set(table.column("camera").to_pylist())
    )
    cos_sin = np.array([np.cos(u).mean(), np.sin(u).mean()])
    return _DatedResult(name, pair, R_cs0, utc, cos_sin, alike)


def _context(path: Path) -> dict[str, Any]:
    file = path / "evidence" / "context.json"
    if not file.is_file():
        return {}
    return read_json(file)


def _check_alike(first: _DatedResult, other: _DatedResult) -> None:
    for key in first.alike.keys() & other.alike.keys():
        if first.alike[key] != other.alike[key]:
            expected = f"{first.alike[key]}, as in {first.name}: one mounting has one pair of cameras"
            raise RawDataError(other.name, key, str(other.alike[key]), expected)


def drift_json(dated: DatedDrift) -> dict[str, Any]:
    """Content of drift.json; a limit that is not finite means none."""
    drift, step, walk, term = dated.drift, dated.drift.step, dated.drift.walk, dated.drift.orbit_phase
    date, low, high = step_dates(dated)
    merged = drift.merged
    return {
        "results": list(drift.series.names),
        "utc": _dates(dated.epoch, drift.series.t_s),
        "moved": drift.moved,
        "probability_false_alarm": drift.settings.probability_false_alarm,
        "merged": {
            "R_cs": merged.R_cs.as_matrix().tolist(),
            "quaternion": merged.R_cs.as_quat(canonical=True).tolist(),
            "theta_rad": theta_between(merged.R_cs, dated.R_cs0).tolist(),
            "covariance_rad2": merged.covariance.tolist(),
        },
        "constant": {
            "chi2": drift.constant.chi2,
            "dof": drift.constant.dof,
            "p_value": drift.constant.p_value,
        },
        "step": {
            "after": step.after,
            "before": step.before,
            "utc": date,
            "utc_interval": [low, high],
            "confidence": drift.settings.confidence,
            "theta_rad": step.theta_step.tolist(),
            "covariance_rad2": step.covariance.tolist(),
            "chi2_gain": step.gain,
            "p_value": step.p_value,
        },
        "random_walk": {
            "density_rad2_s": walk.density_rad2_s,
            "density_interval_rad2_s": walk.density_interval,
            "estimated": walk.estimated,
            "theta_rad": walk.theta.tolist(),
            "covariance_rad2": walk.covariance.tolist(),
        },
        "orbit_phase": None
        if term is None
        else {
            "cosine_rad": term.cosine.tolist(),
            "sine_rad": term.sine.tolist(),
            "covariance_rad2": term.covariance.tolist(),
            "p_value": term.p_value,
        },
        "version": __version__,
    }


def drift_verdict(dated: DatedDrift) -> str:
    """Sentence that says whether the mounting has moved."""
    said = "the mounting has moved" if dated.drift.moved else "no sign that the mounting has moved"
    return f"{said}, at a false-alarm probability of {dated.drift.settings.probability_false_alarm:.2g}"


def _interval(drift: Drift) -> str:
    low, high = (_per_root_day(value) for value in drift.walk.density_interval)
    return f"{drift.settings.confidence:.0%} between {low:.4g} and {high:.4g}"


def _per_root_day(density_rad2_s: float) -> float:
    return math.sqrt(density_rad2_s * DAY_S) / ARCSEC


def step_dates(dated: DatedDrift) -> tuple[str, str, str]:
    """Most likely date of the step and the ends of its interval, UTC."""
    step = dated.drift.step
    date, low, high = _dates(dated.epoch, np.array([step.t_s, *step.interval_s]))
    return date, low, high


def _dates(epoch: Epoch, t_s: Array) -> list[str]:
    """UTC to the whole second."""
    return [f"{utc[:19]}Z" for utc in epoch.utc_from_seconds(t_s)]
