"""Evidence of the report's map: footprints, targets and their residuals on the ground, and pictures of it.

Strips whose footprints touch form a scene. A scene has a plane of its own (azimuthal equidistant projection
about its middle, metres to the east and north), so that a map of strips on several continents needs no
projection of the whole Earth. Residuals of targets become metres on the ground through the derivatives of the
strip's rigorous model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from typing import Any

import cv2
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pyproj import Transformer
from scipy.sparse.csgraph import connected_components

from boresight.calib.estimate import TargetResiduals
from boresight.gct_match.search.coarse import means_of_usable, read_coarse
from boresight.gct_match.settings import MatchSettings
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef, local_axes_e
from boresight.geometry.pushbroom import Pushbroom
from boresight.geometry.terrain import ConstantHeight, Surface
from boresight.pipeline.calibration.calibrate import DumpCalibration
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.images.tiff import StripFiles
from boresight.pipeline.files.star_side import SolvedAttitudes
from boresight.pipeline.files.table_files import arrow_rows
from boresight.pipeline.files.terrain_files import TargetHeights, surface_of
from boresight.pipeline.report.star_preview import jpeg_of
from boresight.pipeline.stages.strip import MatchedTargets, StripTask, pushbroom_of
from boresight.records.ledger import Entry, Kind, State, Subject
from boresight.records.record import Floats, Ints, array, inner, record, scalar

__all__ = [
    "STATES",
    "MapScene",
    "Overview",
    "StripOnGround",
    "ground_table",
    "local_plane",
    "overview",
    "quicklooks_of",
    "scene_json",
    "scene_pictures",
    "scenes_of",
    "shadings_of",
]

# States of a target in a strip, as the tables of the evidence and the map name them.
STATES = (State.USED, State.REJECTED, State.UNMATCHED, State.OUT_OF_VIEW)
MOST_SIDE_PX = 420  # of a picture
MOST_OUT_OF_VIEW = 500  # targets of a scene
EDGE_POINTS = 9  # along each edge of a CCD's footprint
MARGIN = 0.06  # of a scene's size, around the footprints
OVERVIEW_PX = 420  # least length of the longer side of an overview, if the image has as many pixels
LEAST_ROWS = 100  # of the overview of a strip that is read in bands
BAND_LINES = 4  # image lines that are read, and averaged, for a row of such an overview
# Columns of evidence/ground.parquet: texts, places (deg, m), axes of residuals, all numbers.
TEXTS = ("strip_id", "target_id", "state", "cause", "reason")
PLACES = ("lat_deg", "lon_deg", "height_m", "east_m", "north_m")
RESIDUALS = ("east", "north", "along", "across")
NUMBERS = (
    *PLACES,
    *("t_s", "temperature_c", "sample_px", "line_px", "residual_m", "sigmas"),
    *(f"residual_{axis}_m" for axis in RESIDUALS),
)
SCHEMA = pa.schema(
    [("scene", pa.int64()), ("ccd", pa.int64())]
    + [(name, pa.string()) for name in TEXTS]
    + [(name, pa.float64()) for name in NUMBERS]
)
NODES = 33  # of the lattice that maps ground to pixels, along each side
SUN = np.array([-0.5, 0.5, np.sqrt(0.5)])  # east, north, up: light from the north-west, as on maps
RELIEF = 4.0  # slopes are shown so many times steeper


@record(kw_only=True)
class StripOnGround:
    """A strip with its final model and where its CCDs look."""

    task: StripTask = scalar("strip with the calibrated installation matrix")
    model: Pushbroom = scalar("its rigorous model")
    outlines_e: Floats = array("C, P, 3", "outline of each CCD's footprint, ITRS, m; NaN where it sees none")
    strip_id = inner[str]("task.strip.strip_id", "id of the strip")

    def box_m(self, scene: MapScene) -> tuple[float, float, float, float]:
        """West, south, east, north end of what it shows, m on the plane of the scene."""
        outline = scene.plane_m(self.outlines_e[np.isfinite(self.outlines_e).all(axis=2)])
        (west, south), (east, north) = outline.min(axis=0).tolist(), outline.max(axis=0).tolist()
        return west, south, east, north


@record(kw_only=True)
class MapScene:
    """Strips whose footprints touch, in a local plane."""

    lat_deg: float = scalar("geodetic latitude of the plane's origin")
    lon_deg: float = scalar("its longitude, degrees")
    strips: tuple[StripOnGround, ...] = scalar("in order of time")
    box_m: tuple[float, float, float, float] = scalar("west, south, east, north end of the map, m")

    def plane_m(self, p_e: Floats) -> Floats:
        """Points (N, 3) ITRS to metres (N, 2) east, north."""
        lat, lon, _ = geodetic_from_ecef(p_e)
        degrees = np.degrees(lon).tolist(), np.degrees(lat).tolist()  # of one-element arrays pyproj warns
        return np.column_stack(local_plane(self.lat_deg, self.lon_deg).transform(*degrees))


@cache
def local_plane(lat_deg: float, lon_deg: float) -> Transformer:
    """Longitude, latitude (degrees) to metres east, north of a place."""
    local = f"+proj=aeqd +lat_0={lat_deg} +lon_0={lon_deg} +ellps=WGS84"
    return Transformer.from_pipeline(
        f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step {local}"
    )


def scenes_of(dump: Dump, calibration: DumpCalibration) -> tuple[MapScene, ...]:
    """The strips of which a CCD sees the ground throughout, grouped by footprints that touch, in order of
    time.
    """
    surface, R_cs = surface_of(dump.terrain), calibration.estimate.R_cs
    seen = [_on_ground(replace(task, R_cs=R_cs), surface) for task in calibration.tasks]
    seen = [one for one in seen if np.isfinite(one.outlines_e).all(axis=(1, 2)).any()]
    if not seen:
        return ()
    middles = np.array([np.nanmean(one.outlines_e, axis=(0, 1)) for one in seen])
    reach = [float(np.nanmax(np.linalg.norm(s.outlines_e - m, axis=2))) for s, m in zip(seen, middles)]
    distance = np.linalg.norm(middles[:, None] - middles, axis=2)
    _, groups = connected_components(distance <= np.add.outer(reach, reach))
    first = {int(group): n for n, group in reversed(list(enumerate(groups)))}
    ordered = sorted(first, key=lambda group: first[group])
    return tuple(_scene([one for one, g in zip(seen, groups) if g == group]) for group in ordered)


def _on_ground(task: StripTask, surface: Surface) -> StripOnGround:
    model = pushbroom_of(task)
    model, outlines = model.tabulated(*model.known_rows()), []
    for ccd in range(task.camera.n_ccds):
        s1, l1 = task.camera.n_px(ccd) - 0.5, task.strip.ccd_lines.get(ccd, task.strip.lines) - 0.5
        across, along = np.linspace(-0.5, s1, EDGE_POINTS), np.linspace(-0.5, l1, EDGE_POINTS)
        sample = np.concatenate([across, np.full(EDGE_POINTS, s1), across[::-1], np.full(EDGE_POINTS, -0.5)])
        line = np.concatenate([np.full(EDGE_POINTS, -0.5), along, np.full(EDGE_POINTS, l1), along[::-1]])
        outlines.append(model.ground_points(ccd, sample, line, surface))
    return StripOnGround(task=task, model=model, outlines_e=np.array(outlines))


def _scene(strips: Sequence[StripOnGround]) -> MapScene:
    points = np.concatenate([one.outlines_e.reshape(-1, 3) for one in strips])
    lat, lon, _ = geodetic_from_ecef(np.nanmean(points, axis=0)[None])
    scene = MapScene(
        lat_deg=round(float(np.degrees(lat[0])), 4),
        lon_deg=round(float(np.degrees(lon[0])), 4),
        strips=tuple(strips),
        box_m=(0.0, 0.0, 0.0, 0.0),
    )
    xy = scene.plane_m(points[np.isfinite(points).all(axis=1)])
    low, high = xy.min(axis=0), xy.max(axis=0)
    margin = MARGIN * float((high - low).max())
    (west, south), (east, north) = (low - margin).tolist(), (high + margin).tolist()
    return replace(scene, box_m=(west, south, east, north))


def scene_json(scene: MapScene) -> dict[str, object]:
    """What the map draws of a scene without its targets and pictures."""
    strips = []
    for one in scene.strips:
        seen = one.outlines_e[np.isfinite(one.outlines_e).all(axis=(1, 2))]
        outlines = [np.round(scene.plane_m(outline), 1).tolist() for outline in seen]
        strips.append({"id": one.strip_id, "outlines_m": outlines})
    return {"lat_deg": scene.lat_deg, "lon_deg": scene.lon_deg, "box_m": list(scene.box_m), "strips": strips}


def ground_table(scenes: Sequence[MapScene], dump: Dump, calibration: DumpCalibration) -> pa.Table:
    """One row for each target and CCD of a strip that was used, rejected or not matched, and for each target
    beside a scene that no strip shows (`strip_id` empty, `ccd` -1).
    """
    every = list[dict[str, object]]()
    for number, scene in enumerate(scenes):
        rows = [row for one in scene.strips for row in _rows_of_strip(one, calibration)]
        rows += _out_of_view(scene, dump, {str(row["target_id"]) for row in rows})
        every += _placed(rows, number, scene, dump)
    return arrow_rows(every, SCHEMA)


def _rows_of_strip(one: StripOnGround, calibration: DumpCalibration) -> Iterator[dict[str, object]]:
    """Rows of the targets that a strip shows, without their places on the ground."""
    strip_id, found = one.strip_id, calibration.estimate.targets
    matched = next(m for m in calibration.matched if m.strip_id == strip_id)
    keys = zip(found.strip_id.tolist(), found.target_id.tolist(), found.ccd.tolist())
    row_of = {(t, c): n for n, (s, t, c) in enumerate(keys) if s == strip_id}
    why = {entry.subject: entry for entry in calibration.omissions}
    names = list(zip(matched.target_id.tolist(), matched.ccd.tolist()))
    rows = np.array([row_of.get(key, -1) for key in names], dtype=np.int64)
    residuals_m = _residuals_m(one, matched, rows, found)
    for n, ((target, ccd), row) in enumerate(zip(names, rows.tolist())):
        subject = Subject(Kind.TARGET, strip=strip_id, ccd=int(ccd), id=target)
        entry, state = why.get(subject, Entry(subject)), State.REJECTED
        if row >= 0 and found.kept[row]:
            entry, state = Entry(subject), State.USED
        numbers = dict(zip((f"residual_{axis}_m" for axis in RESIDUALS), residuals_m[n].tolist()))
        if row >= 0:
            size = float(np.linalg.norm(residuals_m[n, :2]))
            numbers |= {"residual_m": size, "sigmas": float(np.sqrt(found.statistic[row]))}
        yield _row(one, entry, state, matched.xy_px[n]) | numbers
    places = one.task.places
    for entry in matched.omissions:
        subject = entry.subject
        if subject.kind not in (Kind.TARGET, Kind.CHIP):
            continue
        xy_px: Floats = np.full(2, np.nan)
        if subject.ccd >= 0:
            xy_px = np.concatenate(one.model.pixels_from_ground(subject.ccd, places[subject.id].p_e[None]))
        yield _row(one, entry, State.UNMATCHED, xy_px)


def _row(
    one: StripOnGround | None, entry: Entry, state: State, xy_px: Floats | None = None
) -> dict[str, object]:
    ccd = entry.subject.ccd
    texts = one.strip_id if one else "", entry.subject.id, state.value, entry.reason.value, entry.text
    row: dict[str, object] = {**dict.fromkeys(NUMBERS, np.nan), **dict(zip(TEXTS, texts)), "ccd": ccd}
    if one is not None and xy_px is not None and np.isfinite(xy_px).all():
        t_s = float(one.model.instants_of_lines(ccd, xy_px[1:])[0])
        row |= {"sample_px": float(xy_px[0]), "line_px": float(xy_px[1]), "t_s": t_s}
    return row


def _residuals_m(one: StripOnGround, matched: MatchedTargets, rows: Ints, found: TargetResiduals) -> Floats:
    """Residuals (N, 4) of matched targets in metres: east, north, along the track and to the right of it.
    `rows` (N,) are theirs in `found`, -1 for none.
    """
    residuals_m = np.full((len(rows), 4), np.nan)
    places = one.task.places
    p_all_e = np.array([places[name].p_e for name in matched.target_id.tolist()]).reshape(-1, 3)
    for k in np.unique(matched.ccd).tolist():
        here = np.flatnonzero((matched.ccd == k) & (rows >= 0))
        if not len(here):
            continue
        lat, lon, height = geodetic_from_ecef(p_all_e[here])
        to_plane = np.swapaxes(local_axes_e(lat, lon)[:, :, :2], 1, 2)  # east, north
        level_m, xy_px = float(height.mean()), matched.xy_px[here]
        ccds = np.full(len(here), k)
        J_c = one.model.directions_and_jacobian(ccds, xy_px, height_m=level_m)[1]
        residual_px = np.linalg.solve(J_c[:, :2], found.residual_c[rows[here], :, None])
        middle, beside, below = (
            one.model.ground_points(k, xy_px[:, 0] + right, xy_px[:, 1] + down, ConstantHeight(level_m))
            for right, down in ((0, 0), (1, 0), (0, 1))
        )
        J_e = np.stack([beside - middle, below - middle], axis=2)
        plane_m = (to_plane @ J_e @ residual_px)[:, :, 0]
        motion = one.task.orbit.velocities_e(one.model.instants_of_lines(k, xy_px[:, 1]))
        along = np.einsum("nji,ni->nj", to_plane, motion)
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        across = along[:, ::-1] * [1.0, -1.0]
        track_m = [(plane_m * axis).sum(axis=1) for axis in (along, across)]
        residuals_m[here] = np.column_stack([plane_m, *track_m])
    return residuals_m


def _out_of_view(scene: MapScene, dump: Dump, named: set[str]) -> list[dict[str, object]]:
    """Targets on the map that no strip of the scene shows, at most `MOST_OUT_OF_VIEW`."""
    targets = [target for target in dump.targets if target.target_id not in named]
    if not targets:
        return []
    middle = np.nanmean(np.concatenate([s.outlines_e.reshape(-1, 3) for s in scene.strips]), axis=0)
    p_e = np.array([target.p_e for target in targets])
    west, south, east, north = scene.box_m
    near = np.flatnonzero(np.linalg.norm(p_e - middle, axis=1) < 0.8 * np.hypot(east - west, north - south))
    if not len(near):
        return []
    x, y = scene.plane_m(p_e[near]).T
    inside = near[(x > west) & (x < east) & (y > south) & (y < north)]
    names = [targets[n].target_id for n in inside[:MOST_OUT_OF_VIEW]]
    return [_row(None, Entry(Subject(Kind.TARGET, id=name)), State.OUT_OF_VIEW) for name in names]


def _placed(
    rows: list[dict[str, object]], number: int, scene: MapScene, dump: Dump
) -> Iterator[dict[str, object]]:
    """The rows with their scene and the places of their targets."""
    if not rows:
        return
    places = {target.target_id: target for target in dump.targets}
    for one in scene.strips:
        places |= one.task.places
    p_e = np.array([places[str(row["target_id"])].p_e for row in rows])
    lat, lon, height = geodetic_from_ecef(p_e)
    east, north = scene.plane_m(p_e).T
    columns = np.column_stack([np.degrees(lat), np.degrees(lon), height, east, north])
    warm = _temperatures_c(dump, np.array([row["t_s"] for row in rows], dtype=float))
    for row, place, temperature in zip(rows, columns.tolist(), warm.tolist()):
        yield row | {"scene": number, "temperature_c": temperature} | dict(zip(PLACES, place))


def _temperatures_c(dump: Dump, t_s: Floats) -> Floats:
    """Temperatures (N,) of the reference head at instants (N,); NaN where they are not stated."""
    source = dump.heads[0].source
    if not isinstance(source, SolvedAttitudes) or source.rows.temperature_c is None:
        return np.full(len(t_s), np.nan)
    return np.interp(t_s, source.rows.t_s, source.rows.temperature_c, left=np.nan, right=np.nan)


def quicklooks_of(scenes: Sequence[MapScene]) -> list[Callable[[], Any]]:
    """What makes the picture (rows, columns) of each CCD's image, in order of scenes, strips and CCDs."""
    return [
        partial(_quicklook, replace(scene, strips=()), one, ccd)
        for scene in scenes
        for one in scene.strips
        for ccd in one.task.strip.images.ccds
    ]


def shadings_of(scenes: Sequence[MapScene], dump: Dump) -> list[Callable[[], Any]]:
    """What makes the picture (rows, columns) of each scene's terrain, if there is one."""
    surface = surface_of(dump.terrain)
    return [] if isinstance(surface, TargetHeights) else [partial(_shaded, one, surface) for one in scenes]


def scene_pictures(
    scenes: Sequence[MapScene],
    shadings: Sequence[NDArray[np.uint8]],
    quicklooks: Iterable[NDArray[np.float32]],
) -> pa.Table:
    """Pictures on the scenes' planes, north up: shaded terrain (`strip_id` empty), a quicklook a strip,
    joined from those of its CCDs, each (rows, columns).
    """
    seen = iter(quicklooks)
    rows: list[dict[str, object]] = []
    for number, scene in enumerate(scenes):
        rows += [_picture(number, "", scene.box_m, image) for image in shadings[number : number + 1]]
        for one in scene.strips:
            if parts := list(islice(seen, len(one.task.strip.images.ccds))):
                rows.append(_picture(number, one.strip_id, one.box_m(scene), _joined(parts)))
    types = {"scene": pa.int64(), "strip_id": pa.string(), "box_m": pa.list_(pa.float64(), 4)}
    return arrow_rows(rows, pa.schema([*types.items(), ("jpeg", pa.binary())]))


def _picture(
    scene: int, strip_id: str, box_m: Sequence[float], image: NDArray[np.uint8]
) -> dict[str, object]:
    return {"scene": scene, "strip_id": strip_id, "box_m": list(box_m), "jpeg": jpeg_of(image, 70)}


def _lattice(scene: MapScene, box_m: Sequence[float]) -> tuple[Floats, Floats, tuple[int, int]]:
    """Latitudes and longitudes (rad) of `NODES`² nodes that span a box, north up, and the picture's (rows,
    columns).
    """
    west, south, east, north = box_m
    scale = MOST_SIDE_PX / max(east - west, north - south)
    size = max(2, round((north - south) * scale)), max(2, round((east - west) * scale))
    east_m, north_m = np.meshgrid(np.linspace(west, east, NODES), np.linspace(north, south, NODES))
    lon, lat = local_plane(scene.lat_deg, scene.lon_deg).transform(east_m, north_m, direction="INVERSE")
    return np.radians(lat), np.radians(lon), size


def _shaded(scene: MapScene, surface: Surface) -> NDArray[np.uint8]:
    """Hill shading of the terrain."""
    lat, lon, (rows, columns) = _lattice(scene, scene.box_m)
    down_nodes, along_nodes = _weights(rows), _weights(columns)
    lat, lon = (down_nodes @ angle @ along_nodes.T for angle in (lat, lon))
    height = np.nan_to_num(surface.height_m(lat, lon), nan=0.0)
    west, south, east, north = scene.box_m
    down, right = np.gradient(RELIEF * height, (north - south) / rows, (east - west) / columns)
    normal = np.stack([-right, down, np.ones_like(height)])
    light = np.tensordot(SUN, normal, axes=1) / np.linalg.norm(normal, axis=0)
    return np.round(255.0 * np.clip(0.25 + 0.75 * light, 0.0, 1.0)).astype(np.uint8)


def _quicklook(scene: MapScene, one: StripOnGround, ccd: int) -> NDArray[np.float32]:
    """A CCD's image resampled to the map (rows, columns); NaN where it did not look or cannot be read."""
    images, surface = one.task.strip.images, surface_of(one.task.terrain)
    lat, lon, (rows, columns) = _lattice(scene, one.box_m(scene))
    height = np.nan_to_num(surface.height_m(lat, lon), nan=0.0)
    ground_e = ecef_from_geodetic(lat.ravel(), lon.ravel(), height.ravel())
    pixels = np.array(one.model.pixels_from_ground(ccd, ground_e), dtype=np.float32)
    to_size = _lattice_map(rows, columns)
    sample, line = (cv2.remap(v, *to_size, cv2.INTER_LINEAR) for v in pixels.reshape(2, NODES, NODES))
    lines, samples = images.shape(ccd)
    picture = np.full((rows, columns), np.nan, dtype=np.float32)
    with suppress(RawDataError):  # reported as an omission
        seen = overview(images, ccd, one.task.settings)
        x, y = ((v - first) / by for v, first, by in zip((sample, line), seen.first_px, seen.pitch_px))
        inside = (sample > -0.5) & (sample < samples - 0.5) & (line > -0.5) & (line < lines - 0.5)
        shown = cv2.remap(seen.means, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture[inside] = shown[inside]
    return picture


def _joined(parts: Sequence[NDArray[np.float32]]) -> NDArray[np.uint8]:
    """The quicklooks of a strip's CCDs in one, grey from its darkest to its brightest hundredth, black where
    there is none.
    """
    picture = parts[0]
    for part in parts[1:]:
        picture = np.where(np.isfinite(part), part, picture)
    good = picture[np.isfinite(picture)]
    low, high = np.percentile(good, [1.0, 99.0]) if len(good) else (0.0, 1.0)
    scaled = np.clip((picture - low) / max(float(high - low), 1e-6), 0.0, 1.0)
    return np.round(255.0 * np.nan_to_num(scaled, nan=0.0)).astype(np.uint8)


def _weights(pixels: int) -> Floats:
    """Weights (pixels, NODES) of the nodes at the pixels of a side, for linear interpolation."""
    return np.maximum(0.0, 1.0 - np.abs(_on_lattice(pixels)[:, None] - np.arange(NODES)))


def _on_lattice(pixels: int) -> Floats:
    """Places (pixels,) of the pixels of a side on a lattice of `NODES` nodes that spans it."""
    return (np.arange(pixels) + 0.5) / pixels * (NODES - 1)


def _lattice_map(rows: int, columns: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Places of a picture's pixels on the lattice of `NODES`² nodes that spans it."""
    x, y = np.meshgrid(*(_on_lattice(size).astype(np.float32) for size in (columns, rows)))
    return x, y


@record(kw_only=True)
class Overview:
    """Means over blocks of a CCD's image."""

    means: np.ndarray = array("H, W", "counts, single precision; NaN where none is usable")
    first_px: tuple[float, float] = scalar("middle (sample, line) of the first block")
    pitch_px: tuple[int, int] = scalar("samples and lines from one block to the next")


def overview(images: StripFiles, ccd: int, settings: MatchSettings) -> Overview:
    """Means over blocks of a CCD's image, without counts that `settings` exclude. `RawDataError` if it is
    damaged.

    Of a long strip the first lines of each row of its file's tiles are enough: decoding all takes longer
    than matching it.
    """
    lines, samples = images.shape(ccd)
    factor = 1
    while 2 * factor * OVERVIEW_PX < lines and 2 * factor <= min(lines, samples):
        factor *= 2
    height = min(factor, BAND_LINES)
    found = images.read_bands(ccd, height, lines // LEAST_ROWS)
    if found is None:
        coarse = read_coarse(images, ccd, (0, lines), (0, samples), factor, settings).image
        middle = 0.5 * (factor - 1)
        return Overview(means=coarse.astype(np.float32), first_px=(middle, middle), pitch_px=(factor, factor))
    bands, pitch = found
    means = means_of_usable(bands[:, : samples // factor * factor], height, settings).astype(np.float32)
    wide = cv2.resize(means, (samples // factor, len(means)), interpolation=cv2.INTER_AREA)
    return Overview(
        means=np.asarray(wide), first_px=(0.5 * (factor - 1), 0.5 * (height - 1)), pitch_px=(factor, pitch)
    )
