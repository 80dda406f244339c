"""Ground calibration targets: where they are, their chips from a reference ortho-image, and the survey's
errors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pyproj import Transformer

from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.geoid import Geoid
from boresight.records.record import record
from boresight.simulator.ground import BlurredGround
from boresight.simulator.mission_records import ChipImage, GroundTarget, TruePoint
from boresight.simulator.scan import TrueScene, read_ground
from boresight.simulator.scenario import TargetSettings

__all__ = ["Placed", "draw_check_points", "place_targets"]

Array = NDArray[np.float64]


@record
class Placed:
    """One target: what the user gets, and where it truly is."""

    target: GroundTarget
    chip: ChipImage
    truth: tuple[TruePoint, ...]


def place_targets(
    strip_id: str,
    scene: TrueScene,
    lines: int,
    reference: BlurredGround,
    pixel_m: float,
    settings: TargetSettings,
    geoid: Geoid,
    rng: np.random.Generator,
) -> list[Placed]:
    """Targets of one strip, spread over its rows and CCDs.

    `reference` is the ground as the chips show it, `pixel_m` the strip's pixel on the ground. A place
    whose chip has little texture is given up for another one.
    """
    chip_m = pixel_m * settings.chip_pixel
    found = []
    for n in range(settings.per_strip):
        for _ in range(40):  # places looked at before a bland one is taken
            ccd, sample, line = _somewhere(n, scene, lines, settings, rng)
            point_e = scene.model.ground_points(ccd, np.array([sample]), np.array([line]), scene.surface)
            east, north = _on_chip_lattice(point_e, scene.epsg, chip_m)
            image = _chip(east, north, reference, chip_m, settings, rng)
            if image.std() >= np.hypot(settings.least_texture_dn, settings.chip_noise_dn):
                break
        name = f"{strip_id}-t{n + 1:02d}"
        found.append(_surveyed(name, scene, east, north, image, chip_m, settings, geoid, rng))
    names = [target.target_id for target, _, _ in found]
    p_e = np.concatenate([true_e for _, _, true_e in found]) if found else np.zeros((0, 3))
    seen = _true_points(names, strip_id, scene, lines, p_e)
    return [
        Placed(target, chip, tuple(point for point in seen if point.point_id == target.target_id))
        for target, chip, _ in found
    ]


def draw_check_points(
    strip_id: str, scene: TrueScene, lines: int, count: int, rng: np.random.Generator
) -> list[TruePoint]:
    """Points of the ground that a strip sees, spread over its rows and CCDs; known to the truth alone."""
    places = []
    for n in range(count):
        ccd = n % scene.model.camera.n_ccds
        sample = rng.uniform(0.0, scene.model.camera.n_px(ccd) - 1.0)
        line = (n + rng.uniform()) * (lines - 1.0) / count
        places.append(scene.model.ground_points(ccd, np.array([sample]), np.array([line]), scene.surface))
    p_e = np.concatenate(places) if places else np.zeros((0, 3))
    names = [f"{strip_id}-c{n + 1:02d}" for n in range(count)]
    return _true_points(names, strip_id, scene, lines, p_e)


def _somewhere(
    n: int, scene: TrueScene, lines: int, settings: TargetSettings, rng: np.random.Generator
) -> tuple[int, float, float]:
    """CCD, sample and line of a possible place of target n, its chip well inside the image."""
    camera = scene.model.camera
    ccd = n % camera.n_ccds
    margin = 0.75 * settings.chip_size_px
    line = margin + (n + rng.uniform()) / settings.per_strip * (lines - 1.0 - 2.0 * margin)
    return ccd, float(rng.uniform(margin, camera.n_px(ccd) - 1.0 - margin)), float(line)


def _on_chip_lattice(point_e: Array, epsg: int, pixel_m: float) -> tuple[float, float]:
    """The corner of the chip's pixels that is nearest to a ground point: easting and northing."""
    east, north, _ = Transformer.from_crs(4978, epsg, always_xy=True).transform(*point_e[0])
    return round(east / pixel_m) * pixel_m, round(north / pixel_m) * pixel_m


def _chip(
    east: float,
    north: float,
    reference: BlurredGround,
    chip_m: float,
    settings: TargetSettings,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """The reference image around a point, north-up, the point being the corner in its middle."""
    half = round(settings.chip_size_px / settings.chip_pixel / 2.0)
    offset_m = (np.arange(-half, half) + 0.5) * chip_m
    texel_m = reference.texel_m
    column, row = np.meshgrid((east + offset_m) / texel_m - 0.5, -(north - offset_m) / texel_m - 0.5)
    image = 8.0 + 230.0 * read_ground(reference, column, row, rng)
    image += settings.chip_noise_dn * rng.standard_normal(image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def _surveyed(
    target_id: str,
    scene: TrueScene,
    east: float,
    north: float,
    image: NDArray[np.uint8],
    chip_m: float,
    settings: TargetSettings,
    geoid: Geoid,
    rng: np.random.Generator,
) -> tuple[GroundTarget, ChipImage, Array]:
    """A target with the errors of its survey, which its chip's map coordinates share; and its true place."""
    to_map = Transformer.from_crs(4326, scene.epsg, always_xy=True)
    lon_deg, lat_deg = to_map.transform(east, north, direction="INVERSE")
    lat, lon = np.radians([lat_deg]), np.radians([lon_deg])
    height = scene.surface.height_m(lat, lon)
    p_e = ecef_from_geodetic(lat, lon, height)
    error = rng.standard_normal(3) * settings.sigma_m
    reported_east, reported_north = east + error[0], north + error[1]
    reported_lon, reported_lat = to_map.transform(reported_east, reported_north, direction="INVERSE")
    reported_height = height[0] + error[2] - geoid.undulation_m(lat, lon)[0]
    half = len(image) / 2 * chip_m
    affine = (chip_m, 0.0, reported_east - half, 0.0, -chip_m, reported_north + half)
    reported = (float(reported_lat), float(reported_lon), float(reported_height))
    target = GroundTarget(target_id, *reported, "egm96", settings.sigma_m)
    return target, ChipImage(target_id, image, affine, scene.epsg), p_e


def _true_points(
    point_ids: list[str], strip_id: str, scene: TrueScene, lines: int, p_e: Array
) -> list[TruePoint]:
    """Ground points (N, 3) in every CCD that sees them; in the order of the points."""
    lat, lon, height = geodetic_from_ecef(p_e)
    points = []
    for ccd in range(scene.model.camera.n_ccds):
        sample, line = scene.model.pixels_from_ground(ccd, p_e)
        inside = (sample >= -0.5) & (sample <= scene.model.camera.n_px(ccd) - 0.5)
        inside &= (line >= -0.5) & (line <= lines - 0.5)
        for n in np.flatnonzero(inside):
            point = TruePoint(
                point_id=point_ids[n],
                strip_id=strip_id,
                ccd=ccd,
                sample=float(sample[n]),
                line=float(line[n]),
                t_s=float(scene.model.instants(line[n : n + 1])[0]),
                p_e=(float(p_e[n, 0]), float(p_e[n, 1]), float(p_e[n, 2])),
                lat_deg=float(np.degrees(lat[n])),
                lon_deg=float(np.degrees(lon[n])),
                height_ellipsoidal_m=float(height[n]),
            )
            points.append((int(n), point))
    return [point for _, point in sorted(points, key=lambda item: item[0])]
