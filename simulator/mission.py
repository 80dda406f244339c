"""One simulated mission, from a scenario and a seed: everything that goes into a dump, and the truth apart.

The order is that of cause and effect: orbit, attitude, ground, then what the cameras see of it, and last
the reported values and stated errors. Images are made when they are asked for. Every random process draws
from its own stream of random numbers, so that a setting which is changed leaves the others' draws alone.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.earth_orientation import EarthOrientationTable
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.epoch import Epoch
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.geoid import Geoid
from boresight.geometry.groundlight import LightEffects
from boresight.geometry.line_camera import LineCamera, gaussian_sigma_px
from boresight.geometry.orbit import Orbit
from boresight.geometry.pushbroom import Pushbroom, RowClock
from boresight.geometry.starlight import StarPlaces, SurveyedStars
from boresight.geometry.terrain import ConstantHeight, TerrainGrid
from boresight.records.record import record
from boresight.simulator import cameras, mission_records
from boresight.simulator.ground import (
    CHIP_TILE,
    TILE,
    BlurredGround,
    Ground,
    GroundImage,
    ImageGround,
    ProceduralGround,
)
from boresight.simulator.ground_targets import Placed, draw_check_points, place_targets
from boresight.simulator.motion import TrueAttitude, flown_orbit, reported_orbit, scan_attitude, true_attitude
from boresight.simulator.relief import relief_grid
from boresight.simulator.rendered_stars import StarField, with_invented_stars
from boresight.simulator.scan import TrueScene, all_panels, needed_sample_step, panels_near, scan
from boresight.simulator.scenario import Scenario, SkyStripSettings, StripSettings
from boresight.simulator.sky import hot_pixels
from boresight.simulator.sky_scan import SkyScene, hot_columns, sky_around, sky_strip

__all__ = ["render_mission"]

Array = NDArray[np.float64]

_MARGIN_DEG = 0.08  # terrain beyond the strips' corners: a wrong installation matrix looks 2 km aside
# Seconds by which the Earth's orientation is computed beyond the orbit on either side, for light times and
# interpolation.
_EARTH_MARGIN_S = 2.0
_SKY_MARGIN_RAD = 0.005  # around a scan: oscillation, aberration, smear
_AROUND_S = 1.0  # before and after a strip: a point is looked for in its rows and a little beyond


def render_mission(
    scenario: Scenario,
    stars: StarPlaces,
    table: EarthOrientationTable,
    geoid: Geoid,
    seed: int,
    ground_image: GroundImage | None = None,
    survey: SurveyedStars | None = None,
) -> mission_records.Mission:
    """A mission simulated from a scenario; equal seeds give equal bytes. `ValueError` if it is inconsistent.

    `stars` are all that are rendered, those unfit for calibration included; heights refer to `geoid`;
    `ground_image` is the ortho-image that `scenario.ground.image` names; `survey` has stars with their
    errors, as faint as the remote-sensing camera sees them, for scans of the sky.
    """
    if scenario.sky_strips.scans and survey is None:
        raise ValueError("sky_strips.scans: a scan of the sky needs `survey`, the stars that it shows")
    if bool(scenario.ground.image) != (ground_image is not None):
        raise ValueError(
            f"ground.image is {scenario.ground.image!r}: ground_image goes with it, or not at all"
        )
    plan = _Plan.of(scenario, seed)
    world = _World.of(plan, table)
    has_ground = scenario.strips.count > 0
    scenes, terrain = _scenes(plan, world, geoid, ground_image) if has_ground else ([], None)
    targets, checks = _ground_points(plan, scenes, geoid, ground_image)
    sky = _star_field(plan, stars, world)
    scans = _sky_scenes(plan, world, survey) if survey is not None else []
    strips = len(plan.strip_ids) + len(scans)
    position_e = plan.rng("gps").standard_normal((strips, 3)) * scenario.errors.gps_m
    clock_s = plan.rng("clock").standard_normal(strips) * scenario.errors.clock_s
    R_cs0 = cameras.measured_installation(scenario.installation)
    # a strip's error of the receiver's ephemeris holds as far around it as the spacing allows, 6 s at most
    hold_s = 0.5 * plan.strip_s + min(6.0, 0.3 * (scenario.strips.spacing_s - plan.strip_s))
    middles = plan.strips_s + 0.5 * plan.strip_s
    return mission_records.Mission(
        scenario=scenario,
        epoch=world.orbit.epoch,
        orbit=reported_orbit(world.orbit, plan.oem_s, middles, position_e, hold_s),
        star_camera=sky.camera,
        line_camera=cameras.calibrated_line_camera(scenario.line_camera),
        installation=mission_records.Installation(R_cs0, np.array(scenario.installation.sigma_rad)),
        errors=_stated(scenario),
        exposures=_exposures(plan, sky, scans),
        strips=(
            *_strips(plan, scenes, targets, clock_s),
            *_sky_strips(plan, scans, clock_s[len(plan.strip_ids) :]),
        ),
        targets=tuple(item.target for item in targets),
        chips=tuple(item.chip for item in targets),
        terrain=terrain,
        truth=mission_records.Truth(
            seed=seed,
            R_cs=world.attitude.R_cs,
            theta_rad=np.array(scenario.installation.theta_rad),
            line_camera=world.line_camera,
            orbit=reported_orbit(world.orbit, plan.oem_s, plan.strips_s, 0.0 * position_e, 1.0),
            t_attitude_s=plan.attitude_s,
            R_ci=_attitudes(plan, world, scans),
            strips=tuple(
                map(
                    mission_records.TrueStrip,
                    (*plan.strip_ids, *(s.strip_id for s in scans)),
                    clock_s.tolist(),
                    position_e,
                )
            ),
            targets=tuple(point for item in targets for point in item.truth),
            check_points=tuple(checks),
            sky_stars=tuple(star for scene in scans for star in scene.truth()),
            exposure=partial(_true_exposure, plan, sky, scans),
        ),
    )


@record
class _Plan:
    """What is flown, and when everything happens; seconds since the mission's epoch."""

    scenario: Scenario
    seed: int
    epoch: Epoch
    strip_ids: tuple[str, ...]
    strips_s: Array  # (S,) first row of each strip
    strip_s: float  # duration of a strip
    scans_s: Array  # (M,) first row of each scan of the sky
    scan_s: float  # duration of such a strip
    exposures_s: Array  # (K,) middles of the exposures
    scan_of: NDArray[np.int64]  # (K,) scan that an exposure belongs to; -1: a strip of the ground
    oem_s: Array  # nodes of the reported orbit
    attitude_s: Array  # instants of the true attitudes

    @staticmethod
    def of(scenario: Scenario, seed: int) -> _Plan:
        s, rate = scenario.strips, scenario.star_camera.rate_hz
        first = s.first_s + s.spacing_s * np.arange(s.count)
        duration = s.lines * s.row_period_s
        lead, sky = s.exposure_lead_s, scenario.sky_strips
        scans, scan_s = np.array([scan.at_s for scan in sky.scans]), sky.lines * sky.row_period_s
        starts = [*((t, duration, -1) for t in first), *((t, scan_s, n) for n, t in enumerate(scans))]
        ticks = [
            np.arange(np.floor((t - lead) * rate), np.ceil((t + lasts + lead) * rate) + 1.0)
            for t, lasts, _ in starts
        ]
        of = np.repeat([n for _, _, n in starts], [len(one) for one in ticks])
        tick, row = np.unique(np.concatenate(ticks), return_index=True)
        exposures = tick / rate
        step, margin = scenario.orbit.oem_step_s, scenario.orbit.oem_margin_s
        nodes = np.floor((exposures[0] - margin) / step), np.ceil((exposures[-1] + margin) / step)
        oem = np.arange(nodes[0], nodes[1] + 1.0)
        return _Plan(
            scenario=scenario,
            seed=seed,
            epoch=Epoch.from_utc(scenario.epoch_utc),
            strip_ids=tuple(f"s{n + 1:02d}" for n in range(s.count)),
            strips_s=np.asarray(first, dtype=float),
            strip_s=duration,
            scans_s=scans,
            scan_s=scan_s,
            exposures_s=exposures,
            scan_of=of[row],
            oem_s=oem * step,
            attitude_s=np.concatenate([_every_millisecond(t, lasts) for t, lasts, _ in starts]),
        )

    def rng(self, name: str, *index: int) -> np.random.Generator:
        """The stream of random numbers of one purpose."""
        return np.random.default_rng([self.seed, zlib.crc32(name.encode()), *index])

    def key(self, name: str) -> int:
        """A number of one purpose, by which hashes differ."""
        return int(self.rng(name).integers(2**31))


@record
class _World:
    """The satellite as it truly flies, points and looks."""

    earth: EarthRotation
    orbit: Orbit
    attitude: TrueAttitude
    line_camera: LineCamera

    @staticmethod
    def of(plan: _Plan, table: EarthOrientationTable) -> _World:
        scenario = plan.scenario
        start, stop = min(plan.oem_s[0], 0.0) - _EARTH_MARGIN_S, plan.oem_s[-1] + _EARTH_MARGIN_S
        earth = EarthRotation.over(plan.epoch, start - 5.0, stop + 5.0, table)
        orbit = flown_orbit(scenario.orbit, start - 4.0, stop + 4.0, earth)
        R_cs = cameras.installation_of_scenario(scenario.installation)
        chance = plan.rng("attitude")
        attitude = true_attitude(scenario.attitude, scenario.errors, R_cs, orbit, earth, chance)
        calibrated = cameras.calibrated_line_camera(scenario.line_camera)
        camera = cameras.distorted_line_camera(calibrated, scenario.errors, plan.rng("distortion"))
        return _World(earth, orbit, attitude, camera)


def _attitudes(plan: _Plan, world: _World, scans: list[SkyScene]) -> Rotation:
    """The camera's attitudes at `plan.attitude_s`."""
    flown = [world.attitude.R_ci(_every_millisecond(t, plan.strip_s)) for t in plan.strips_s]
    scanned = [one.attitude.R_ci(_every_millisecond(t, plan.scan_s)) for one, t in zip(scans, plan.scans_s)]
    return Rotation.concatenate([*flown, *scanned])


def _every_millisecond(first_s: float, duration_s: float) -> Array:
    return np.arange(first_s, first_s + duration_s, 1e-3, dtype=np.float64)


def _sky_scenes(plan: _Plan, world: _World, survey: SurveyedStars) -> list[SkyScene]:
    """The true geometry of each scan of the sky, and the stars around it."""
    settings, scenes = plan.scenario.sky_strips, []
    pixel_rad = world.line_camera.pixel_rad
    swath_rad = world.line_camera.n_ccds * world.line_camera.n_px(0) * pixel_rad
    for n, (planned, first_s) in enumerate(zip(settings.scans, plan.scans_s.tolist())):
        middle_s = first_s + 0.5 * plan.scan_s
        attitude = scan_attitude(planned, world.attitude, middle_s, pixel_rad, settings.row_period_s)
        long_rad = float(np.hypot(planned.rate, planned.drift)) * settings.lines * pixel_rad
        radius = 0.5 * float(np.hypot(swath_rad, long_rad)) + _SKY_MARGIN_RAD
        chance = plan.rng("sky stars", n)
        scenes.append(
            SkyScene(
                strip_id=f"sky{n + 1:02d}",
                camera=world.line_camera,
                attitude=attitude,
                orbit=world.orbit,
                rows=RowClock(first_s, settings.row_period_s),
                settings=settings,
                rate=planned.rate,
                stars=sky_around(survey, attitude, radius, settings, world.orbit, chance),
            )
        )
    return scenes


def _sky_strips(
    plan: _Plan, scans: list[SkyScene], clock_s: Array
) -> tuple[mission_records.RenderedStrip, ...]:
    """Every CCD of every scan; the time of the first row on the camera's clock."""
    scenario, gains = plan.scenario, _gains(plan)
    camera, settings, detector = scenario.line_camera, scenario.sky_strips, scenario.ground
    hot = [hot_columns(camera.samples, settings, plan.rng("hot columns", ccd)) for ccd in range(camera.ccds)]

    def render(n: int, ccd: int, rows: int) -> Iterator[NDArray[Any]]:
        chance = plan.rng("sky strip", n, ccd)
        return sky_strip(scans[n], ccd, detector, gains[ccd], hot[ccd], chance, rows)

    first_s = {scene.strip_id: float(scene.rows.t_first_row_s + clock_s[n]) for n, scene in enumerate(scans)}
    return _of_ccds(plan, settings, first_s, render, "sky")


def _scenes(
    plan: _Plan, world: _World, geoid: Geoid, ground_image: GroundImage | None
) -> tuple[list[TrueScene], mission_records.TerrainReport]:
    """The true geometry of each strip over the true terrain, and the terrain as the user gets it."""
    scenario = plan.scenario
    models = [
        Pushbroom(
            camera=world.line_camera,
            rows=RowClock(float(t), scenario.strips.row_period_s),
            orbit=world.orbit,
            earth=world.earth,
            attitude=world.attitude.during(float(t) - _AROUND_S, float(t) + plan.strip_s + _AROUND_S),
            R_cs=world.attitude.R_cs,
            effects=LightEffects(),
        )
        for t in plan.strips_s
    ]
    boxes = np.array([_box_deg(model, scenario) for model in models])
    heights, affine = relief_grid(boxes, scenario.terrain, plan.key("relief"))
    surface = TerrainGrid.from_raster(heights, affine, "EPSG:4326", geoid)
    scenes: list[TrueScene] = []
    grounds: dict[int, BlurredGround] = {}  # strips of one zone share their tiles
    for model, (south, west, north, east) in zip(models, boxes):
        zone = int((0.5 * (west + east) + 180.0) % 360.0 // 6.0) + 1  # of UTM
        epsg = (32600 if 0.5 * (south + north) >= 0.0 else 32700) + zone
        if epsg not in grounds:
            grounds[epsg] = _seen_ground(plan, epsg, ground_image, date=1)
        last = float(scenario.strips.lines + 64)
        step = needed_sample_step(model, surface, scenario.strips.lines)
        scenes.append(TrueScene(model.tabulated(-64.0, last), surface, epsg, grounds[epsg], step))
    error = scenario.terrain.error_m * plan.rng("terrain error").standard_normal(heights.shape)
    reported = (heights + error).astype(np.float32)
    return scenes, mission_records.TerrainReport(reported, affine, scenario.terrain.error_m)


def _ground_points(
    plan: _Plan, scenes: list[TrueScene], geoid: Geoid, ground_image: GroundImage | None
) -> tuple[list[Placed], list[mission_records.TruePoint]]:
    """Targets that some CCD sees, and check points, of all strips."""
    targets: list[Placed] = []
    checks: list[mission_records.TruePoint] = []
    references: dict[int, BlurredGround] = {}
    scenario, lines = plan.scenario, plan.scenario.strips.lines
    for n, (strip_id, scene) in enumerate(zip(plan.strip_ids, scenes)):
        chance = plan.rng("targets", n)
        if scene.epsg not in references:
            references[scene.epsg] = _seen_ground(plan, scene.epsg, ground_image, date=0)
        reference = references[scene.epsg]
        pixel_m = scenario.ground_pixel_m
        targets += place_targets(strip_id, scene, lines, reference, pixel_m, scenario.targets, geoid, chance)
        chance = plan.rng("check points", n)
        checks += draw_check_points(strip_id, scene, lines, scenario.targets.check_points_per_strip, chance)
    return [item for item in targets if item.truth], checks


def _seen_ground(plan: _Plan, epsg: int, ground_image: GroundImage | None, date: int) -> BlurredGround:
    """The ground as the strips' optics show it (date 1), or the reference image's (date 0)."""
    settings, targets = plan.scenario.ground, plan.scenario.targets
    texel_m = plan.scenario.ground_pixel_m / settings.texels_per_pixel
    ground: Ground
    if ground_image is not None:
        ground = ImageGround(ground_image, texel_m, epsg)
    else:
        ground = ProceduralGround(settings, texel_m, plan.key("ground"), date)
    if date == 1:
        sigma_px = gaussian_sigma_px(settings.mtf_nyquist)
    else:
        sigma_px = gaussian_sigma_px(targets.chip_mtf_nyquist) * targets.chip_pixel
    return BlurredGround(ground, sigma_px * settings.texels_per_pixel, TILE if date == 1 else CHIP_TILE)


def _star_field(plan: _Plan, stars: StarPlaces, world: _World) -> StarField:
    camera, sky = cameras.star_camera(plan.scenario.star_camera), plan.scenario.sky
    shining = with_invented_stars(stars, sky, plan.rng("invented stars"))
    hot = hot_pixels(camera.width_px, camera.height_px, sky, plan.rng("hot pixels"))
    return StarField(
        camera=camera, sky=sky, stars=shining, orbit=world.orbit, attitude=world.attitude, hot=hot
    )


def _seen_during(sky: StarField, scans: list[SkyScene], scan: int) -> StarField:
    """The star camera's sky with the attitude of a scan; -1: of the flight over ground."""
    return sky if scan < 0 else replace(sky, attitude=scans[scan].attitude)


def _exposures(
    plan: _Plan, sky: StarField, scans: list[SkyScene]
) -> tuple[mission_records.RenderedExposure, ...]:
    duration = plan.scenario.star_camera.exposure_s

    def render(n: int) -> NDArray[Any]:
        seen = _seen_during(sky, scans, int(plan.scan_of[n]))
        return seen.image(float(plan.exposures_s[n]), duration, plan.rng("exposure", n))

    return tuple(
        mission_records.RenderedExposure(_exposure_id(n), float(t), duration, partial(render, n))
        for n, t in enumerate(plan.exposures_s)
    )


def _true_exposure(
    plan: _Plan, sky: StarField, scans: list[SkyScene], exposure_id: str
) -> mission_records.TrueExposure:
    n = {_exposure_id(n): n for n in range(len(plan.exposures_s))}[exposure_id]
    seen = _seen_during(sky, scans, int(plan.scan_of[n]))
    return seen.truth(exposure_id, float(plan.exposures_s[n]), plan.scenario.star_camera.exposure_s)


def _exposure_id(n: int) -> str:
    return f"e{n + 1:04d}"


def _strips(
    plan: _Plan, scenes: list[TrueScene], targets: list[Placed], clock_s: Array
) -> tuple[mission_records.RenderedStrip, ...]:
    """Every CCD of every strip; the time of the first row on the camera's clock."""
    scenario, gains = plan.scenario, _gains(plan)
    camera, s, ground = scenario.line_camera, scenario.strips, scenario.ground

    def render(n: int, ccd: int, rows: int) -> Iterator[NDArray[Any]]:
        chance = plan.rng("strip", n, ccd)
        return scan(scenes[n], ccd, s.lines, ground, gains[ccd], chance, rows, wanted(n, ccd))

    def wanted(n: int, ccd: int) -> NDArray[np.bool_]:
        if not s.only_around_targets_px:
            return all_panels(s.lines, camera.samples)
        seen = [p for item in targets for p in item.truth if (p.strip_id, p.ccd) == (plan.strip_ids[n], ccd)]
        places = np.array([(p.sample, p.line) for p in seen]).reshape(-1, 2)
        return panels_near(places, s.only_around_targets_px, s.lines, camera.samples)

    first_s = (plan.strips_s + clock_s[: s.count]).tolist()
    return _of_ccds(plan, s, dict(zip(plan.strip_ids, first_s)), render, "ground")


def _of_ccds(
    plan: _Plan,
    settings: StripSettings | SkyStripSettings,
    first_s: dict[str, float],
    render: Callable[[int, int, int], Iterator[NDArray[Any]]],
    kind: str,
) -> tuple[mission_records.RenderedStrip, ...]:
    """Every CCD of strips, whose first rows are at `first_s`; `render` takes strip, CCD and rows at once."""
    camera = plan.scenario.line_camera
    return tuple(
        mission_records.RenderedStrip(
            strip_id=strip_id,
            ccd=ccd,
            lines=settings.lines,
            samples=camera.samples,
            t_first_row_s=t_s,
            row_period_s=settings.row_period_s,
            bits=plan.scenario.ground.bits,
            blocks=partial(render, n, ccd),
            kind=kind,
        )
        for n, (strip_id, t_s) in enumerate(first_s.items())
        for ccd in range(camera.ccds)
    )


def _gains(plan: _Plan) -> list[NDArray[np.float32]]:
    """Sensitivity of each pixel of each CCD."""
    camera, sigma = plan.scenario.line_camera, plan.scenario.ground.pixel_gain_sigma
    spread = [plan.rng("gain", ccd).standard_normal(camera.samples) for ccd in range(camera.ccds)]
    return [(1.0 + sigma * each).astype(np.float32) for each in spread]


def _stated(scenario: Scenario) -> mission_records.StatedErrors:
    errors = scenario.errors
    return mission_records.StatedErrors(
        position_m=errors.gps_m,
        clock_s=errors.clock_s,
        vibration_arcsec=errors.vibration_arcsec,
        look_distortion_px=errors.distortion_px,
        look_ccd_px=errors.ccd_px,
    )


def _box_deg(model: Pushbroom, scenario: Scenario) -> tuple[float, float, float, float]:
    """South, west, north, east of what a strip sees, with a margin."""
    last = float(scenario.strips.lines - 1)
    corners = []
    for ccd in (0, model.camera.n_ccds - 1):
        end = float(model.camera.n_px(ccd) - 1)
        sample, line = np.array([0.0, end, 0.0, end]), np.array([0.0, 0.0, last, last])
        corners.append(model.ground_points(ccd, sample, line, ConstantHeight(scenario.terrain.mean_m)))
    lat, lon, _ = geodetic_from_ecef(np.concatenate(corners))
    lat_deg = np.degrees(lat)
    lon_deg = np.degrees(lon[0] + (lon - lon[0] + np.pi) % (2.0 * np.pi) - np.pi)  # in one piece across 180
    wide = _MARGIN_DEG / float(np.cos(lat.mean()))
    return (
        float(lat_deg.min() - _MARGIN_DEG),
        float(lon_deg.min() - wide),
        float(lat_deg.max() + _MARGIN_DEG),
        float(lon_deg.max() + wide),
    )
