"""Targets from ortho-images and height models, as a folder that goes into a dump.

ortho-images -> places of sharp, unique texture -> those that look alike at other dates (images that overlap)
-> heights -> those that the dump's strips will show -> the choice with the smallest forecast covariance
-> chips (GeoTIFF) and targets.csv
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pyproj import CRS, Transformer
from rasterio.transform import Affine
from scipy.stats import norm

from boresight.features.targets.ortho_files import HeightModel, Ortho
from boresight.features.targets.suggest import SuggestedTarget, suggest_targets
from boresight.features.targets.target_choice import TargetChoice, choose_targets
from boresight.gct_match.records import Target
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.record import Floats, array, record, scalar
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.dump_schema import GroundReferenceFile
from boresight.pipeline.files.ground_points import ChipFile
from boresight.pipeline.files.images.tiff import write_tiff
from boresight.pipeline.files.text_tables import write_csv, write_toml
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.stages.match_pictures import NO_PICTURES
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, pushbroom_of
from boresight.pipeline.stages.strip_tasks import strips_with_stars

__all__ = ["Candidate", "SuggestRequest", "Suggestion", "suggest_in", "suggestion_lines", "write_targets"]

CANDIDATES = 4  # for each target wanted
LEAST_CORRELATION = 0.3  # between dates; below it a place has changed
MOVE_PX = 8  # of one date's image against another's, px
OVERLAP_PLACES = 400  # places of an image that are looked up in the height model
# 1-sigma by which a place moves between two dates, each axis, px: other shadows and plants. 0.054 px on the
# pair of Sentinel-2 in benchmarks/results/match_real_pairs.txt, chips of 64 px; pairs elsewhere had 0.07 px.
SIGMA_OF_DATES_PX = 0.07
LEAST_IN_VIEW = 0.05  # probability below which a strip counts as not showing a candidate
# docs/dump-format.md
TARGET_COLUMNS = "id lat_deg lon_deg height_m height_kind sigma_east_m sigma_north_m sigma_up_m chip".split()


@record(kw_only=True)
class SuggestRequest:
    """What is wanted."""

    size_px: int = scalar("side of a chip, pixels of its image")
    most: int = scalar("number of targets")
    sigma_m: float = scalar("1-sigma of the images' georeferencing, each coordinate")
    sigma_up_m: float = scalar("1-sigma of the heights")


@record(kw_only=True)
class Candidate:
    """A possible target."""

    target_id: str = scalar("id")
    ortho: Ortho = scalar("image of its chip")
    place: SuggestedTarget = scalar("place in the image, expected sigma, rival")
    lat_deg: float = scalar("latitude")
    lon_deg: float = scalar("longitude")
    height_m: float = scalar("height as targets.csv has it")
    height_kind: str = scalar("ellipsoidal or egm96")
    p_e: Floats = array("3", "ITRS, m")
    alike: float = scalar("least correlation with the place at other dates; 1 with one date")
    sigma_m: Floats = array("3", "1-sigma east, north, up: georeferencing and texture")


@record
class Suggestion:
    """The targets, and the accuracy that they forecast."""

    targets: tuple[Candidate, ...] = scalar("best first")
    choice: TargetChoice | None = scalar("forecast with the first n targets; None without a dump")
    suitable: tuple[Candidate, ...] = scalar("all places to choose from, with a dump those in view")


def suggest_in(
    orthos: Sequence[Ortho],
    heights: HeightModel,
    request: SuggestRequest,
    dump: Dump | None = None,
    settings: Settings | None = None,
) -> Suggestion:
    """Targets in ortho-images: with a dump those that its strips will show, spread for the best forecast.

    `RawDataError` for an image too small for its chips, `DataNotSufficientError` where no place is suitable.
    """
    for ortho in orthos:
        _check_overlap(ortho, heights)
    found = [one for ortho in orthos for one in _candidates(ortho, orthos, heights, request)]
    named = [replace(one, target_id=f"t{n:03d}") for n, one in enumerate(found, start=1)]
    if not named:
        raise DataNotSufficientError(
            f"{', '.join(ortho.file for ortho in orthos)}: no place has a texture that is sharp, found only "
            "once, alike at all dates and covered by the heights"
        )
    if dump is None:
        best = sorted(named, key=lambda one: one.place.sigma_px / one.alike)[: request.most]
        return Suggestion(tuple(best), None, tuple(named))
    choice, in_view = _chosen(named, dump, settings or Settings(), request.most)
    if not in_view:
        raise DataNotSufficientError(f"{dump.root}: no strip shows any of {len(named)} suitable places")
    by_id = {one.target_id: one for one in named}
    chosen, suitable = (tuple(by_id[n] for n in names) for names in (choice.target_id, sorted(in_view)))
    return Suggestion(chosen, choice, suitable)


def suggestion_lines(found: Suggestion) -> list[str]:
    """A line for each target, then the forecast."""
    lines = []
    for one in found.targets:
        place = one.place
        where = f"{Path(one.ortho.file).name}: column {place.column:.0f}, row {place.row:.0f}"
        sigma_px = np.hypot(place.sigma_px, SIGMA_OF_DATES_PX)
        quality = f"expected sigma {sigma_px:.4f} px, best rival {place.rival:.2f}"
        lines.append(f"{one.target_id}   {where}   {quality}, alike {one.alike:.2f}")
    if found.choice is not None:
        x, y, z = found.choice.sigma_rad[-1] / ARCSEC
        lines.append(f"forecast 1 sigma, arcsec     X {x:.4f}   Y {y:.4f}   Z {z:.4f}")
    return lines


def write_targets(
    targets: Sequence[Candidate], out: Path, size_px: int, reference: GroundReferenceFile | None = None
) -> Path:
    """Write chips/ and targets.csv into the folder `out`; the path of the table. With a `reference`, of whose
    offset all targets have a part, the table names it, and ground_references.toml has it for dump.toml.
    """
    (out / "chips").mkdir(parents=True, exist_ok=True)
    rows = []
    for one in targets:
        name = f"chips/{one.target_id}.tif"
        _write_chip(out / name, one, size_px)
        place = [f"{one.lat_deg:.10f}", f"{one.lon_deg:.10f}", f"{one.height_m:.3f}", one.height_kind]
        rows.append([one.target_id, *place, *(f"{value:.3f}" for value in one.sigma_m), name])
    columns = list(TARGET_COLUMNS)
    if reference is not None:
        columns, rows = [*columns, "reference"], [[*row, reference.id] for row in rows]
        write_toml(out / "ground_references.toml", {"ground_references": [reference.model_dump()]})
    write_csv(out / "targets.csv", columns, rows)
    return out / "targets.csv"


def _check_overlap(ortho: Ortho, heights: HeightModel) -> None:
    """`RawDataError` where no height model covers any of some places all over an image."""
    rows, columns = np.nonzero(ortho.valid)
    some = np.linspace(0, len(rows) - 1, OVERLAP_PLACES).astype(int)
    a, b, c, d, e, f = ortho.transform
    column, row = columns[some] + 0.5, rows[some] + 0.5
    x, y = a * column + b * row + c, d * column + e * row + f
    lon, lat = (np.array(v, dtype=float) for v in _to_degrees(ortho.crs).transform(x, y))
    if not np.isfinite(heights.stated(lat, lon)[0]).any():
        found = f"latitude {lat.min():.4f} to {lat.max():.4f}, longitude {lon.min():.4f} to {lon.max():.4f}"
        files = ", ".join(heights.files)
        raise RawDataError(ortho.file, "place", found, f"ground that a height model covers: {files} does not")


def _candidates(
    ortho: Ortho, orthos: Sequence[Ortho], heights: HeightModel, request: SuggestRequest
) -> list[Candidate]:
    """Suitable places of one image that no earlier image covers."""
    try:
        places = suggest_targets(
            ortho.values,
            ortho.transform,
            ortho.valid,
            size_px=request.size_px,
            most=CANDIDATES * request.most,
        )
    except ValueError as error:
        raise RawDataError(ortho.file, "image size", str(error), "a larger image or smaller chips") from error
    lon, lat = (np.array(v, dtype=float) for v in _to_degrees(ortho.crs).transform(*_xy(places)))
    height, kind = heights.stated(lat, lon)
    ellipsoidal = heights.ellipsoidal(lat, lon)
    p_e = ecef_from_geodetic(np.radians(lat), np.radians(lon), ellipsoidal, WGS84)
    earlier = orthos[: [other is ortho for other in orthos].index(True)]
    pixel_m = _pixel_m(ortho, places, p_e, ellipsoidal)
    found = []
    for n, place in enumerate(places):
        if not np.isfinite(height[n]) or any(_chip_at(o, lon[n], lat[n], 8) is not None for o in earlier):
            continue
        alike = _alike(ortho, place, lon[n], lat[n], [o for o in orthos if o is not ortho], request.size_px)
        if alike < LEAST_CORRELATION:
            continue
        level = float(np.hypot(request.sigma_m, np.hypot(place.sigma_px, SIGMA_OF_DATES_PX) * pixel_m))
        found.append(
            Candidate(
                target_id="",
                ortho=ortho,
                place=place,
                lat_deg=float(lat[n]),
                lon_deg=float(lon[n]),
                height_m=float(height[n]),
                height_kind=kind,
                p_e=p_e[n],
                alike=alike,
                sigma_m=np.array([level, level, request.sigma_up_m]),
            )
        )
    return found


@lru_cache(maxsize=64)
def _to_degrees(crs: str) -> Transformer:
    """From a map to longitude and latitude."""
    return Transformer.from_crs(CRS.from_user_input(crs), "EPSG:4326", always_xy=True)


def _xy(places: Sequence[SuggestedTarget]) -> tuple[list[float], list[float]]:
    return [place.x for place in places], [place.y for place in places]


def _pixel_m(ortho: Ortho, places: Sequence[SuggestedTarget], p_e: Floats, height: Floats) -> float:
    """Side of a pixel of the image on the ground, m, at its first place."""
    good = np.flatnonzero(np.isfinite(height))
    if not len(good):
        return 0.0
    a, _, _, d, _, _ = ortho.transform
    place = places[int(good[0])]
    lon, lat = _to_degrees(ortho.crs).transform(place.x + a, place.y + d)
    beside_e = ecef_from_geodetic(np.radians([lat]), np.radians([lon]), height[good[:1]], WGS84)
    return float(np.linalg.norm(beside_e[0] - p_e[good[0]]))


def _alike(
    ortho: Ortho, place: SuggestedTarget, lon: float, lat: float, others: Sequence[Ortho], size_px: int
) -> float:
    """Least correlation of a chip with the same ground in other images, shifts of some pixels allowed."""
    chip = _window(ortho.values, place.column, place.row, size_px)
    found = [1.0]
    for other in others:
        wide = _chip_at(other, lon, lat, size_px + 2 * MOVE_PX)
        if wide is not None:
            found.append(float(cv2.matchTemplate(wide, chip, cv2.TM_CCOEFF_NORMED).max()))
    return max(0.0, min(found))


def _chip_at(ortho: Ortho, lon: float, lat: float, size_px: int) -> NDArray[np.float32] | None:
    """The window of an image around a point; None where the image has no data."""
    x, y = _to_degrees(ortho.crs).transform(lon, lat, direction="INVERSE")
    a, b, c, d, e, f = ortho.transform[:6]
    column, row = np.linalg.solve([[a, b], [d, e]], [x - c, y - f])
    half = size_px // 2
    inside = half <= column < ortho.values.shape[1] - half and half <= row < ortho.values.shape[0] - half
    if not (np.isfinite([column, row]).all() and inside):
        return None
    valid = _window(ortho.valid, column - 0.5, row - 0.5, size_px)
    return _window(ortho.values, column - 0.5, row - 0.5, size_px) if valid.all() else None


def _window(values: NDArray, column: float, row: float, size_px: int) -> NDArray:
    left, top = round(column) - size_px // 2, round(row) - size_px // 2
    return values[top : top + size_px, left : left + size_px]


def _chosen(
    named: Sequence[Candidate], dump: Dump, settings: Settings, most: int
) -> tuple[TargetChoice, set[str]]:
    """The candidates that make the forecast covariance smallest, and all that the strips may show."""
    matched, probabilities = [], []

    def shown(task: StripTask) -> tuple[StripTask, MatchedTargets]:
        targets = tuple(Target(one.target_id, one.p_e, one.sigma_m) for one in named)
        chips = tuple(ChipFile(one.target_id, "", Path()) for one in named)
        in_view, probability = _in_view(task, named)
        probabilities.append(probability)
        matched.append(in_view)
        return replace(task, targets=targets, chips=chips), in_view

    strips = strips_with_stars(dump, settings, shown)
    kept = [p for p, one in zip(probabilities, matched) if len(one.target_id)]
    error_model = calibration_settings(settings, dump.errors, dump.line_camera)
    in_view = {name for one in matched for name in one.target_id.tolist()}
    sigma = dump.sigma_installation_rad
    return choose_targets(strips, kept, dump.R_cs0, sigma, error_model, most), in_view


def _in_view(task: StripTask, named: Sequence[Candidate]) -> tuple[MatchedTargets, Floats]:
    """Candidates that a strip may show with the pre-launch matrix, as if they were matched where it predicts
    them, and the probability that they will be: in view in spite of the matrix's error, and alike.
    """
    model, camera = pushbroom_of(task), task.camera
    p_e = np.array([one.p_e for one in named])
    places, ccds = np.zeros((len(named), 2)), np.zeros(len(named), dtype=np.int64)
    chance: Floats = np.zeros(len(named))
    for ccd, lines in sorted(task.strip.ccd_lines.items()):
        sample, line = model.pixels_from_ground(ccd, p_e)
        J = np.linalg.norm(model.pixel_jacobian(ccd, np.array([0.0]), np.array([0.0]))[0], axis=0)
        across, along = task.sigma_installation_rad[[0, 1]] / J
        here = _inside(sample, camera.n_px(ccd), across) * _inside(line, lines, along)
        better = here > chance
        chance, ccds[better] = np.where(better, here, chance), ccd
        places[better] = np.column_stack(
            [np.clip(sample, 0, camera.n_px(ccd) - 1), np.clip(line, 0, lines - 1)]
        )[better]
    rows = np.flatnonzero(chance > LEAST_IN_VIEW)
    sigma_px = np.hypot([named[n].place.sigma_px for n in rows], SIGMA_OF_DATES_PX)
    matched = MatchedTargets(
        strip_id=task.strip.strip_id,
        target_id=np.array([named[n].target_id for n in rows], dtype=str),
        ccd=ccds[rows],
        xy_px=places[rows],
        cov_px=sigma_px[:, None, None] ** 2 * np.eye(2),
        correlation=np.ones(len(rows)),
        probability_wrong=np.zeros(len(rows)),
        predicted_px=places[rows],
        pictures=(NO_PICTURES,) * len(rows),
        omissions=(),
    )
    return matched, chance[rows] * np.array([named[n].alike for n in rows])


def _inside(place: Floats, size: int, sigma: float) -> Floats:
    """Probability that a coordinate with 1-sigma `sigma` lies on a detector of `size` px; 0 for NaN."""
    low, high = norm.cdf(place / sigma), norm.cdf((place - (size - 1)) / sigma)
    return np.nan_to_num(np.asarray(low - high))


def _write_chip(path: Path, one: Candidate, size_px: int) -> None:
    image = _window(one.ortho.values, one.place.column, one.place.row, size_px)
    left, top = round(one.place.column) - size_px // 2, round(one.place.row) - size_px // 2
    a, b, c, d, e, f = one.ortho.transform[:6]
    transform = Affine(a, b, c + a * left + b * top, d, e, f + d * left + e * top)
    whole = bool(np.all(image == np.round(image))) and image.min() >= 0.0 and image.max() <= 65535.0
    kind = "uint8" if whole and image.max() <= 255.0 else "uint16" if whole else "float32"
    write_tiff(path, image.astype(kind), crs=one.ortho.crs, transform=transform)
