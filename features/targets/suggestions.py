"""Targets from ortho-images and height models, as a folder that goes into a dump.

ortho-images, tile by tile -> places of sharp, unique texture -> heights -> matches in images of other dates
-> offsets that two dates have in common -> places that were found again where these offsets put them
-> those that the dump's strips will show -> the choice with the smallest forecast covariance
-> chips (GeoTIFF), targets.csv and ground_references.toml
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.transform import Affine
from scipy.stats import norm

from boresight.features.targets.ortho_files import HeightModel, RasterFile, RasterWindow, map_to_map, mapped
from boresight.features.targets.suggest import SuggestedTarget, suggest_targets
from boresight.features.targets.target_choice import TargetChoice, choose_targets
from boresight.gct_match.imaging.views import in_counts
from boresight.gct_match.locate import locate_template
from boresight.gct_match.records import Image, Target
from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.pipeline.console.arguments import option
from boresight.pipeline.errors import DataNotSufficientError, RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.dump_schema import GroundReferenceFile
from boresight.pipeline.files.ground_points import ChipFile
from boresight.pipeline.files.images.tiff import write_tiff
from boresight.pipeline.files.text_tables import write_csv, write_toml
from boresight.pipeline.run.settings import Settings, calibration_settings
from boresight.pipeline.stages.match_pictures import NO_PICTURES
from boresight.pipeline.stages.observed_strips import sighted_strips
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, pushbroom_of
from boresight.pipeline.stages.strip_tasks import before_launch
from boresight.records.ledger import Entry
from boresight.records.record import Floats, array, record, scalar

__all__ = ["Candidate", "SuggestRequest", "Suggestion", "suggest_in", "suggestion_lines", "write_targets"]

CANDIDATES = 4  # for each target wanted
TILE_PX = 2048  # side of what is read at once of an image, px; at least four chips
PLACE_PX = 128  # side of the middle of a chip that is matched in other dates: that of a strip's template
MOVE_PX = 12  # of one date's image against another's, px
SPARE_PX = 8  # around the search, for the match
COARSEST = 4.0  # pixel of an image in which a place is matched, of those of the place's own
LEAST_AGAIN = 0.5  # share of the other dates in which a place is found again; below it, it has changed
LEAST_COMMON = 3  # places from which the offset between two dates is taken
OFF_PX, OFF_SIGMAS = 1.0, 3.0  # beyond both of the common offset, a match is of something that has moved
OVERLAP_PLACES = 20  # of each side of an image that are looked up in the height model
# 1-sigma by which a place moves between two dates, each axis, px: other shadows and plants. 0.054 px on a
# pair of Sentinel-2, chips of 64 px; pairs elsewhere had 0.07 px.
SIGMA_OF_DATES_PX = 0.07
DEGREES = "EPSG:4326"
LEAST_IN_VIEW = 0.05  # probability below which a strip counts as not showing a candidate
# docs/dump-format.md
TARGET_COLUMNS = "id lat_deg lon_deg height_m height_kind sigma_east_m sigma_north_m sigma_up_m chip".split()


@record(kw_only=True)
class SuggestRequest:
    """What is wanted."""

    size_px: int = option("Side of a chip, in pixels of its image.", 256, min=32)
    most: int = option("So many targets at most.", 40, min=1)
    sigma_m: float = option("1-sigma of the images' georeferencing.", 1.0, min=0.0)
    sigma_up_m: float = option("1-sigma of the heights.", 2.0, min=0.0)


@record
class Again:
    """A place found in the image of another date."""

    label: str = scalar("of that image")
    offset_px: Floats = array("2", "column, row beyond where the maps put it, or the dates' common offset")
    sigma_px: float = scalar("1-sigma of the match in the worse direction")


@record(kw_only=True)
class Candidate:
    """A possible target."""

    target_id: str = scalar("id")
    ortho: RasterFile = scalar("image of its chip")
    place: SuggestedTarget = scalar("place in the image, expected sigma, rival")
    lat_deg: float = scalar("latitude")
    lon_deg: float = scalar("longitude")
    height_m: float = scalar("height as targets.csv has it")
    height_kind: str = scalar("ellipsoidal or egm96")
    p_e: Floats = array("3", "ITRS, m")
    pixel_m: Floats = array("2, 2", "east and north by column and row of the image, m per px")
    stated_m: tuple[float, float] = scalar("1-sigma of georeferencing, each coordinate, and of heights")
    others: int = scalar("number of images of other dates that show its ground")
    again: tuple[Again, ...] = scalar("where it was found in them")

    @property
    def probability(self) -> float:
        """That another image shows it unchanged, by Laplace's rule of succession."""
        return (len(self.again) + 1.0) / (self.others + 2.0)

    @property
    def sigma_px(self) -> float:
        """Expected standard error of a match, each axis: of the texture, and of what dates differ by."""
        moved = np.array([one.offset_px for one in self.again]).reshape(-1, 2)
        dates = np.sqrt(np.mean(moved**2)) if len(moved) else 0.0
        return float(np.hypot(self.place.sigma_px, max(SIGMA_OF_DATES_PX, dates)))

    @property
    def sigma_m(self) -> Floats:
        """1-sigma (3,) east, north, up: georeferencing and match."""
        level = np.hypot(self.stated_m[0], self.sigma_px * _side(self.pixel_m))
        return np.array([level, level, self.stated_m[1]])


@record
class Suggestion:
    """The targets, and the accuracy that they forecast."""

    targets: tuple[Candidate, ...] = scalar("best first")
    choice: TargetChoice | None = scalar("forecast with the first n targets; None without a dump")
    suitable: tuple[Candidate, ...] = scalar("all places to choose from, with a dump those in view")
    offsets: dict[tuple[str, str], Floats] = scalar(
        "east, north of an image's places in that of another date, m"
    )
    unused: tuple[str, ...] = scalar("images of which no height model covers any ground")

    def references(
        self, name: str, offset_m: float | None, offset_up_m: float
    ) -> dict[str, GroundReferenceFile]:
        """By an image's label the reference of its targets: `name`, of the offset that is stated; without one
        a reference an image, as far off as the dates scatter.
        """
        found: dict[str, tuple[str, float]] = {}
        if offset_m is not None:
            found = {one.ortho.label: (name, offset_m) for one in self.targets}
        for n, label in enumerate(sorted({own for own, _ in self.offsets}) if offset_m is None else ()):
            of_dates = np.array([np.zeros(2), *(o for (own, _), o in self.offsets.items() if own == label)])
            scatter_m = float(np.sqrt(np.mean(of_dates.var(axis=0, ddof=1))))
            id = f"{name}-{re.sub(r'[^A-Za-z0-9_.-]', '-', label)}"[:64]
            found[label] = f"{id[:59]}-{n}" if id in dict(found.values()) else id, scatter_m
        return {
            label: GroundReferenceFile(
                id=id, sigma_east_m=sigma, sigma_north_m=sigma, sigma_up_m=offset_up_m, correlation_km=0.0
            )
            for label, (id, sigma) in found.items()
        }


def suggest_in(
    orthos: Sequence[RasterFile],
    heights: HeightModel,
    request: SuggestRequest,
    dump: Dump | None = None,
    settings: Settings | None = None,
) -> Suggestion:
    """Targets in ortho-images: with a dump those that its strips will show, spread for the best forecast.

    Where images overlap, the first one gives the chips. `RawDataError` for an image too small for its chips
    and where the heights cover none, `DataNotSufficientError` where no place is suitable.
    """
    missing = {ortho.path: _without_heights(ortho, heights) for ortho in orthos}
    covered = [ortho for ortho in orthos if missing[ortho.path] is None]
    if not covered and (error := missing[orthos[0].path]):
        raise error
    area = sum(math.prod(ortho.shape) for ortho in covered)
    places = [one for n in range(len(covered)) for one in _candidates(n, covered, heights, request, area)]
    offsets = _common_offsets(places)
    stable = [one for place in places if (one := _stable(place, offsets)) is not None]
    named = [replace(one, target_id=f"t{n:03d}") for n, one in enumerate(stable, start=1)]
    if not named:
        shown = ", ".join(str(ortho.path) for ortho in covered[:5])
        raise DataNotSufficientError(
            f"{shown}: no place has a texture that is sharp, found only once, found again at other dates and "
            f"covered by the heights, of {len(places)} looked for"
        )
    unused = tuple(str(path) for path, error in missing.items() if error is not None)
    if dump is None:
        best = sorted(named, key=lambda one: -one.probability / one.sigma_px**2)[: request.most]
        return Suggestion(tuple(best), None, tuple(named), offsets, unused)
    choice, in_view = _chosen(named, dump, settings or Settings(), request.most)
    if not in_view:
        raise DataNotSufficientError(f"{dump.root}: no strip shows any of {len(named)} suitable places")
    by_id = {one.target_id: one for one in named}
    chosen, suitable = (tuple(by_id[n] for n in names) for names in (choice.target_id, sorted(in_view)))
    return Suggestion(chosen, choice, suitable, offsets, unused)


def suggestion_lines(found: Suggestion) -> list[str]:
    """A line for each target, then the forecast."""
    lines = []
    for one in found.targets:
        place = one.place
        where = f"{one.ortho.path.name}: column {place.column:.0f}, row {place.row:.0f}"
        quality = f"expected sigma {one.sigma_px:.4f} px, best rival {place.rival:.2f}"
        again = f"found again in {len(one.again)} of {one.others} images of other dates"
        lines.append(f"{one.target_id}   {where}   {quality}, {again}")
    for (own, other), (east, north) in found.offsets.items():
        lines.append(f"{other} against {own}: {east:+.2f} m east, {north:+.2f} m north")
    lines += [f"not used: {file}: no height model covers it" for file in found.unused]
    if found.choice is not None:
        x, y, z = found.choice.sigma_rad[-1] / ARCSEC
        lines.append(f"forecast 1 sigma, arcsec     X {x:.4f}   Y {y:.4f}   Z {z:.4f}")
    return lines


def write_targets(
    targets: Sequence[Candidate],
    out: Path,
    size_px: int,
    references: Mapping[str, GroundReferenceFile] | None = None,
) -> Path:
    """Write chips/ and targets.csv into the folder `out`; the path of the table. With `references`, of whose
    offset all targets of images of that label have a part, the table names them, and ground_references.toml
    has them for dump.toml.
    """
    (out / "chips").mkdir(parents=True, exist_ok=True)
    rows: list[list[Any]] = []
    named: dict[str, Any] = {}
    for one in targets:
        name = f"chips/{one.target_id}.tif"
        _write_chip(out / name, one, size_px)
        place = [f"{one.lat_deg:.10f}", f"{one.lon_deg:.10f}", f"{one.height_m:.3f}", one.height_kind]
        rows.append([one.target_id, *place, *(f"{value:.3f}" for value in one.sigma_m), name])
        if references:
            reference = references.get(one.ortho.label)
            rows[-1].append("" if reference is None else reference.id)
            named |= {} if reference is None else {reference.id: reference.model_dump()}
    if named:
        write_toml(out / "ground_references.toml", {"ground_references": list(named.values())})
    write_csv(out / "targets.csv", [*TARGET_COLUMNS, "reference"] if references else TARGET_COLUMNS, rows)
    return out / "targets.csv"


def _without_heights(ortho: RasterFile, heights: HeightModel) -> RawDataError | None:
    """What is wrong where no height model covers any of some places all over an image."""
    side = np.linspace(0.0, 1.0, OVERLAP_PLACES)
    column, row = (v.ravel() for v in np.meshgrid(side * ortho.shape[1], side * ortho.shape[0]))
    lon, lat = map_to_map(ortho.crs, DEGREES).transform(*mapped(ortho.transform, column, row))
    if np.isfinite(heights.stated(lat, lon)[0]).any():
        return None
    found = f"latitude {lat.min():.4f} to {lat.max():.4f}, longitude {lon.min():.4f} to {lon.max():.4f}"
    files = ", ".join(heights.files)
    expected = f"ground that a height model covers: {files} does not"
    return RawDataError(str(ortho.path), "place", found, expected)


def _candidates(
    n: int, orthos: Sequence[RasterFile], heights: HeightModel, request: SuggestRequest, area: int
) -> Iterator[Candidate]:
    """Places of the n-th image that no earlier one shows, tile by tile, and where those of other dates show
    them. `area` is that of all images, px: each tile has its part of the candidates.
    """
    ortho, margin = orthos[n], request.size_px // 2 + 1
    if min(ortho.shape) < 2 * request.size_px:
        found, expected = f"{ortho.shape[1]} x {ortho.shape[0]} px", f"two chips of {request.size_px} px"
        raise RawDataError(str(ortho.path), "image size", found, f"at least {expected}")
    spans = [_spans(size, max(TILE_PX, 4 * request.size_px), margin) for size in ortho.shape]
    for (top, bottom), (left, right) in product(*spans):
        tile = ortho.window(left, top, right - left, bottom - top)
        if (valid := np.isfinite(tile.values)).any():
            share = math.ceil(CANDIDATES * request.most * valid.size / area)
            yield from _of_tile(tile, (left, top), n, orthos, heights, request, share)


def _spans(size: int, tile: int, margin: int) -> list[tuple[int, int]]:
    """First and last pixel of tiles along one side, which overlap by a margin: no place is in two of them."""
    edges = np.linspace(0, size, math.ceil(size / tile) + 1).astype(int).tolist()
    return [(max(0, low - margin), min(size, high + margin)) for low, high in pairwise(edges)]


def _of_tile(
    tile: RasterWindow,
    corner: tuple[int, int],
    n: int,
    orthos: Sequence[RasterFile],
    heights: HeightModel,
    request: SuggestRequest,
    most: int,
) -> Iterator[Candidate]:
    """At most `most` places of a tile of the n-th image whose first pixel is `corner` (column, row)."""
    ortho, size = orthos[n], request.size_px
    valid = np.isfinite(tile.values)
    grey = in_counts(np.nan_to_num(tile.values), valid)
    places = suggest_targets(grey, tile.transform, valid, size_px=size, most=most)
    x, y = np.array([[one.x, one.y] for one in places]).reshape(-1, 2).T
    lon, lat = map_to_map(ortho.crs, DEGREES).transform(x, y)
    height, kind = heights.stated(lat, lon)
    p_e = ecef_from_geodetic(np.radians(lat), np.radians(lon), heights.ellipsoidal(lat, lon))
    kept = set(np.flatnonzero(np.isfinite(height)).tolist())
    others, again = np.zeros(len(places), dtype=int), defaultdict[int, list[Again]](list)
    for k, other in enumerate(orthos if kept else ()):
        is_date = k > n and not (ortho.day and other.day == ortho.day) and _is_as_fine(other, ortho)
        if k == n or (k > n and not is_date):
            continue
        view = other.resampled(tile)
        shown = {i for i in kept if np.isfinite(_window(view.values, places[i], size)).all()}
        if k < n:
            kept -= shown
        if not is_date or not shown:
            continue
        picture = np.pad(view.values, MOVE_PX + SPARE_PX, constant_values=np.nan)
        for i in shown:
            others[i] += 1
            again[i] += _found_again(tile, picture, places[i], min(size, PLACE_PX), other.label)
    for i in sorted(kept):
        column, row = places[i].column + corner[0], places[i].row + corner[1]
        yield Candidate(
            target_id="",
            ortho=ortho,
            place=replace(places[i], column=column, row=row),
            lat_deg=float(lat[i]),
            lon_deg=float(lon[i]),
            height_m=float(height[i]),
            height_kind=kind,
            p_e=p_e[i],
            pixel_m=_pixel_m(ortho, column, row),
            stated_m=(request.sigma_m, request.sigma_up_m),
            others=int(others[i]),
            again=tuple(again[i]),
        )


def _is_as_fine(other: RasterFile, ortho: RasterFile) -> bool:
    """Whether pixels of an image are small enough for places of `ortho` to be matched in it."""
    sides = [_side(_pixel_m(one, 0.0, 0.0)) for one in (other, ortho)]
    return sides[0] <= COARSEST * sides[1]


def _pixel_m(ortho: RasterFile, column: float, row: float) -> Floats:
    """East and north (2, 2), m, by column and row of an image at a pixel, on a sphere."""
    xy = mapped(ortho.transform, column + np.array([0.0, 1.0, 0.0]), row + np.array([0.0, 0.0, 1.0]))
    lon, lat = np.radians(map_to_map(ortho.crs, DEGREES).transform(*xy))
    east_north = np.stack([np.cos(lat[0]) * (lon[1:] - lon[0]), lat[1:] - lat[0]])
    return np.asarray(WGS84.semi_major_m * east_north)


def _side(pixel_m: Floats) -> float:
    """Side of a pixel, m."""
    return float(np.sqrt(abs(np.linalg.det(pixel_m))))


def _found_again(
    tile: RasterWindow, picture: Image, place: SuggestedTarget, side: int, label: str
) -> list[Again]:
    """The middle of a place's chip, found in another image on the same pixels with a border; empty if not."""
    reach = MOVE_PX + SPARE_PX
    around = _window(picture, place, side + 2 * reach, reach)
    centre = reach + 0.5 * (side - 1)
    match = locate_template(_window(tile.values, place, side), around, (centre, centre), MOVE_PX)
    if isinstance(match, Entry):
        return []
    return [Again(label, match.xy_px - centre, float(np.sqrt(np.linalg.eigvalsh(match.cov_px)[-1])))]


def _common_offsets(places: Sequence[Candidate]) -> dict[tuple[str, str], Floats]:
    """East, north (2,), m: median of places of images of one date in those of another."""
    pairs = defaultdict[tuple[str, str], list[Floats]](list)
    for place in places:
        for one in place.again:
            pairs[place.ortho.label, one.label].append(place.pixel_m @ one.offset_px)
    return {pair: np.median(of, axis=0) for pair, of in pairs.items() if len(of) >= LEAST_COMMON}


def _stable(place: Candidate, offsets: Mapping[tuple[str, str], Floats]) -> Candidate | None:
    """A place with those matches that agree with the dates' common offset, beyond which `offset_px` is then;
    None where too few do.
    """
    good = []
    for one in place.again:
        common = offsets.get((place.ortho.label, one.label), place.pixel_m @ one.offset_px)
        off_px = one.offset_px - np.linalg.solve(place.pixel_m, common)
        if np.hypot(*off_px) <= max(OFF_PX, OFF_SIGMAS * one.sigma_px):
            good.append(replace(one, offset_px=off_px))
    return replace(place, again=tuple(good)) if len(good) >= LEAST_AGAIN * place.others else None


def _window(values: Image, place: SuggestedTarget, size_px: int, pad: int = 0) -> Image:
    left, top = round(place.column) - size_px // 2 + pad, round(place.row) - size_px // 2 + pad
    return values[top : top + size_px, left : left + size_px]


def _chosen(
    named: Sequence[Candidate], dump: Dump, settings: Settings, most: int
) -> tuple[TargetChoice, set[str]]:
    """The candidates that make the forecast covariance smallest, and all that the strips may show."""
    heads, tasks, _ = before_launch(dump, settings)
    targets = tuple(Target(one.target_id, one.p_e, one.sigma_m) for one in named)
    chips = tuple(ChipFile(one.target_id, "", Path()) for one in named)
    shown = [_in_view(task, named) for task in tasks]
    matched = [in_view for in_view, _ in shown]
    strips = sighted_strips([replace(task, targets=targets, chips=chips) for task in tasks], matched, heads)
    kept = [probability for in_view, probability in shown if len(in_view.target_id)]
    error_model = calibration_settings(settings, dump.errors, dump.line_camera)
    in_view = {name for one in matched for name in one.target_id.tolist()}
    sigma = dump.sigma_installation_rad
    return choose_targets(strips, kept, dump.R_cs0, sigma, error_model, most), in_view


def _in_view(task: StripTask, named: Sequence[Candidate]) -> tuple[MatchedTargets, Floats]:
    """Candidates that a strip may show with the pre-launch matrix, as if they were matched where it predicts
    them, and the probability that they will be: in view in spite of the matrix's error, and unchanged.
    """
    model, camera = pushbroom_of(task), task.camera
    p_e = np.array([one.p_e for one in named])
    places, ccds = np.zeros((len(named), 2)), np.zeros(len(named), dtype=np.int64)
    chance: Floats = np.zeros(len(named))
    for ccd, lines in sorted(task.strip.ccd_lines.items()):
        sample, line = model.pixels_from_ground(ccd, p_e)
        J_c = model.directions_and_jacobian(np.array([ccd]), np.zeros((1, 2)))[1]
        J = np.linalg.norm(J_c[0], axis=0)
        across, along = task.sigma_installation_rad[[0, 1]] / J
        here = _inside(sample, camera.n_px(ccd), across) * _inside(line, lines, along)
        better = here > chance
        chance, ccds[better] = np.where(better, here, chance), ccd
        places[better] = np.column_stack(
            [np.clip(sample, 0, camera.n_px(ccd) - 1), np.clip(line, 0, lines - 1)]
        )[better]
    rows = np.flatnonzero(chance > LEAST_IN_VIEW)
    sigma_px = np.array([named[n].sigma_px for n in rows])
    matched = MatchedTargets(
        strip_id=task.strip.strip_id,
        target_id=np.array([named[n].target_id for n in rows], dtype=str),
        ccd=ccds[rows],
        xy_px=places[rows],
        cov_px=sigma_px[:, None, None] ** 2 * np.eye(2),
        correlation=np.ones(len(rows)),
        probability_wrong=np.zeros(len(rows)),
        predicted_px=places[rows],
        affine=np.zeros((len(rows), 2, 2)),
        pictures=(NO_PICTURES,) * len(rows),
        omissions=(),
    )
    return matched, chance[rows] * np.array([named[n].probability for n in rows])


def _inside(place: Floats, size: int, sigma: float) -> Floats:
    """Probability that a coordinate with 1-sigma `sigma` lies on a detector of `size` px; 0 for NaN."""
    low, high = norm.cdf(place / sigma), norm.cdf((place - (size - 1)) / sigma)
    return np.nan_to_num(np.asarray(low - high))


def _write_chip(path: Path, one: Candidate, size_px: int) -> None:
    left, top = round(one.place.column) - size_px // 2, round(one.place.row) - size_px // 2
    chip = one.ortho.window(left, top, size_px, size_px)
    image = chip.values
    whole = bool(np.all(image == np.round(image))) and image.min() >= 0.0 and image.max() <= 65535.0
    kind = "uint8" if whole and image.max() <= 255.0 else "uint16" if whole else "float32"
    write_tiff(path, image.astype(kind), crs=chip.crs, transform=Affine(*chip.transform))
