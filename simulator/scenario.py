"""What a simulated mission is asked to be: frozen settings, each with its unit and the reason for its value.

Three scenarios are built in: `mini` (a camera pair of the same field of view with few pixels, for tests),
`paper` (Tables 1-3 of the paper at full size) and `sky` (one scan of the Pleiades, still smaller).
`scenario_from_dict` builds one from a nested dictionary, as a TOML file gives it: what the dictionary leaves
out is taken from the scenario that it is based on, a key that does not exist is refused. Settings are spoken
in the units that a mission's documents use; the unit is in the name.
"""

from __future__ import annotations

import json
import types
from dataclasses import field, replace
from functools import cache
from itertools import pairwise
from operator import attrgetter
from typing import Any, ClassVar

from pydantic import ConfigDict, TypeAdapter, ValidationError

from boresight.records.record import record, value_text

__all__ = [
    "CloudSettings",
    "ErrorSettings",
    "GroundSettings",
    "InstallationSettings",
    "LineCameraSettings",
    "OrbitSettings",
    "OtherDateSettings",
    "PointingSettings",
    "PointingWave",
    "Scenario",
    "ScenarioError",
    "SkyScan",
    "SkySettings",
    "SkyStripSettings",
    "StarCameraSettings",
    "StripSettings",
    "TargetSettings",
    "TerrainSettings",
    "builtin_scenario",
    "builtin_scenario_names",
    "mini_scenario",
    "paper_scenario",
    "scenario_from_dict",
    "scenario_to_dict",
    "sky_scenario",
]


LARGEST = 1e15  # of any number: no setting comes near it
OF_DISTORTION = 0.2  # a CCD's own shift, slope and bend: what a dump means that does not state them


class ScenarioError(ValueError):
    """A scenario that cannot be: names the setting, what was found and what is expected."""


@record(by_value=True)
class OrbitSettings:
    """A sun-synchronous orbit that passes over a given place when time zero of the mission strikes."""

    altitude_km: float = 530.0  # above the equatorial radius (paper, section 3.3)
    inclination_deg: float = 97.5  # sun-synchronous at 530 km: node turns 0.9856 deg a day under J2
    latitude_deg: float = 36.0  # geocentric latitude below the satellite at time zero
    longitude_deg: float = 103.0  # east; with the epoch below, about 10:30 local time
    descending: bool = True  # daylight half of a 10:30 orbit
    oem_step_s: float = 1.0  # the paper's 1 Hz
    oem_margin_s: float = 12.0  # nodes before the first and after the last exposure, for interpolation


@record(by_value=True)
class PointingWave:
    """One sine of the attitude about one axis of the remote-sensing camera."""

    axis: str  # "roll" (about x, flight), "pitch" (about y) or "yaw" (about z, nadir)
    amplitude_arcsec: float
    period_s: float


@record(by_value=True)
class PointingSettings:
    """Nadir pointing (z of frame c to the centre of the Earth), offsets, and the oscillation of Fig. 4."""

    roll_deg: float = 0.0  # off-nadir angle across track
    pitch_deg: float = 0.0
    yaw_deg: float = 0.0
    yaw_steering: bool = True  # x of frame c along the motion over the turning ground, as TDI needs
    waves: tuple[PointingWave, ...] = (  # phases are drawn from the seed; 3-12 arcsec and 3-7 s as in Fig. 4
        PointingWave("roll", 8.0, 5.3),
        PointingWave("roll", 3.0, 3.1),
        PointingWave("pitch", 12.0, 6.7),
        PointingWave("pitch", 4.0, 3.7),
        PointingWave("yaw", 3.0, 6.1),
    )


@record(by_value=True)
class InstallationSettings:
    """Where the star camera sits on the remote-sensing camera, and by how much that was measured wrong."""

    # Of the star camera's axis from -z of frame c (errata: fits the paper's figures).
    zenith_distance_deg: float = 15.0
    azimuth_deg: float = 90.0  # of that axis about z of frame c, from x; 90 is the Y-Z plane
    turn_deg: float = 37.0  # of the star camera about its own axis: lopsided, so that a wrong frame shows
    theta_rad: tuple[float, float, float] = (0.003, 0.002, 0.001)  # R_cs = exp[[theta]] R_cs0, (28), errata
    sigma_rad: tuple[float, float, float] = (0.003, 0.003, 0.003)  # 1 sigma stated for the measured matrix


@record(by_value=True)
class StarCameraSettings:
    """The paper's Table 2."""

    focal_mm: float = 100.0
    pixel_um: float = 6.4
    width_px: int = 5120
    height_px: int = 3840
    principal_px: tuple[float, float] = (2560.0, 1920.0)
    p1: float = 2.29e-5  # the paper's (4)-(6) with image coordinates in millimetres (errata)
    p2: float = -2.96e-5
    q1: float = -9.30e-7
    q2: float = -4.25e-9
    rate_hz: float = 5.0
    exposure_s: float = 0.030  # the sky turns 0.5 px meanwhile at full size: smear stays below the PSF


@record(by_value=True)
class SkySettings:
    """What makes a raw star image out of stars: light, optics, detector."""

    flux_v0_e_per_s: float = 6.0e7  # electrons a second of a star of V = 0: SNR 8 at V = 7 in 30 ms
    color_term: float = 0.0  # detector magnitude = V + color_term (B - V)
    psf_sigma_px: float = 1.25  # Gaussian, integrated over the pixels
    psf_sigma_corner_px: float = 1.25  # grows with the square of the distance from the centre
    faint_stars_per_deg2: float = 0.0  # stars that no catalogue lists, invented from the seed
    faint_v_range: tuple[float, float] = (8.0, 10.0)
    background_dn: float = 12.0  # in the middle of the image, offset included
    background_gradient_dn: tuple[float, float] = (4.0, -3.0)  # change over the width, over the height
    background_bow_dn: float = 2.0  # added in the corners, with the square of the distance from the centre
    e_per_dn: float = 40.0
    read_noise_dn: float = 2.0
    background_shot_noise: bool = True  # the background's own photons are noisy too
    hot_pixels: int = 500  # at the same places in every exposure
    hot_pixel_dn: tuple[float, float] = (20.0, 200.0)
    cosmic_rays: int = 10  # tracks in one exposure (mean)
    cosmic_ray_e: tuple[float, float] = (2000.0, 20000.0)  # electrons that one leaves
    bloom: bool = False  # charge above saturation runs along the column
    bits: int = 8
    sub_exposures_per_px: float = 4.0  # steps of the smear, in each pixel of path


@record(by_value=True)
class LineCameraSettings:
    """The paper's Table 3. Four CCDs, staggered along track, overlapping across track."""

    focal_m: float = 10.0
    pixel_um: float = 10.0
    ccds: int = 4
    samples: int = 6144
    principal_sample: float = 3067.0
    overlap_px: float = 200.0  # of neighbours, distortion included
    stagger_mm: float = 20.0  # odd CCDs lie this far off in x_f: room for the splicing reflector
    rotation_urad: tuple[float, ...] = (12.0, -8.0, 5.0, -14.0)  # of each CCD, below 2 um of splicing
    # Law that fills Table 3: offset = -(a r^3 + b r^5), r = sample - principal_sample. Both printed values
    # (1077.2 um at 56, 866.3 um at 203) are met, and the principal sample has none. See docs/simulator.md.
    distortion_um: tuple[tuple[float, float], tuple[float, float]] = ((56.0, 1077.2), (203.0, 866.3))
    distortion_nodes: int = 49  # entries of the table that the camera file gets
    tdi_stages: int = 1


@record(by_value=True)
class StripSettings:
    """When the remote-sensing camera takes its strips, and which star exposures go with them."""

    count: int = 3
    first_s: float = 2.0  # first row of the first strip after time zero
    spacing_s: float = 20.0  # from strip to strip; long enough for the GPS error to change
    lines: int = 26000
    row_period_s: float = 1.8 / 26000
    exposure_lead_s: float = 0.3  # exposures reach this far before the first and after the last row
    only_around_targets_px: float = 0.0  # beyond it zeros, for trials of size: 20 times sooner; 0: all of it


@record(by_value=True)
class SkyScan:
    """One strip that the remote-sensing camera takes of the sky, at a constant rate in any direction."""

    ra_deg: float  # where its optical axis points in the middle of the scan, ICRS
    dec_deg: float
    at_s: float  # first row after time zero; both cameras must see past the Earth then
    position_angle_deg: float = 0.0  # of +x of frame c there, from north through east
    rate: float = 1.0  # pixels in a row period, as over the ground; negative: the other way
    drift: float = 0.0  # samples in a row period, to the side


@record(by_value=True)
class SkyStripSettings:
    """Strips of the sky. The detector is that of `GroundSettings`."""

    scans: tuple[SkyScan, ...] = ()
    lines: int = 26000
    # Six times the ground's: more light, the clock's error displaces stars by less, and those of the star
    # camera's 30 ms exposures smear by 1 px instead of 7.
    row_period_s: float = 6 * 1.8 / 26000
    only_around_stars_px: float = 0.0  # beyond it zeros, for trials of size; 0: all of it
    flux_v0_e_per_s: float = 1.4e10  # V = 0: 1 m of aperture, 40 % of the photons from 450 to 900 nm
    psf_sigma_px: float = 0.55  # Gaussian of the optics alone; pixels, rows and TDI blur further
    background_dn: float = 12.0  # offset, so that the read noise is not cut off
    hot_columns: int = 20  # samples of each CCD that are brighter in all rows, and noisier
    hot_column_dn: tuple[float, float] = (2.0, 60.0)
    cosmic_rays: int = 10  # hits of a CCD in a strip (mean)
    cosmic_ray_e: tuple[float, float] = (1000.0, 10000.0)
    # Stars that Hipparcos does not list, away from the Milky Way; three times as many from one magnitude to
    # the next
    uncatalogued_per_deg2: float = 6.0
    uncatalogued_v_range: tuple[float, float] = (8.5, 10.5)


@record(by_value=True)
class TerrainSettings:
    """Fractal relief, given to the user as a grid of orthometric heights."""

    mean_m: float = 400.0
    relief_m: float = 120.0  # 1 sigma of the heights
    feature_km: float = 8.0  # size of the largest hills
    roughness: float = 0.45  # ratio of amplitudes from one octave to the next; 0.5 is a rough mountain
    spacing_arcsec: float = 3.0  # of the grid
    error_m: float = 0.0  # 1 sigma of the grid that the user gets, on top of the truth


@record(by_value=True)
class CloudSettings:
    """Partial cloud in the strips."""

    cover: float = 0.0  # fraction of the ground covered
    size_km: float = 1.5
    brightness: float = 0.85  # reflectance


@record(by_value=True)
class OtherDateSettings:
    """The strips see the ground at another date than the chips do. Nothing changes by default."""

    gamma: float = 1.0
    ramp: float = 0.0  # relative change of illumination over 10 km
    changed_fields: float = 0.0  # fraction of the parcels that bear another crop
    occlusion: float = 0.0  # fraction of the ground covered by new dark or bright patches


@record(by_value=True)
class GroundSettings:
    """The ground's look and how the cameras render it."""

    image: str = ""  # path of a GeoTIFF to be used instead of the procedural ground; "" is procedural
    texels_per_pixel: float = 1.4  # ground texture's sampling against the strip's pixel; linear in between
    parcel_m: float = 140.0  # mean side of a field
    detail: float = 1.0  # strength of the fractal texture on fields, 1 = realistic
    water: float = 0.05  # fraction of parcels
    settlement: float = 0.18
    forest: float = 0.22
    mtf_nyquist: float = 0.15  # of the strip, optics + detector + motion, at its own Nyquist frequency
    dn_full_scale: float = 255.0  # strip grey value of reflectance 1 (below saturation when bits allow)
    bits: int = 8
    e_per_dn: float = 60.0
    read_noise_dn: float = 0.8
    pixel_gain_sigma: float = 0.002  # residual non-uniformity from pixel to pixel of the line
    cloud: CloudSettings = CloudSettings()
    other_date: OtherDateSettings = OtherDateSettings()


@record(by_value=True)
class TargetSettings:
    """Ground calibration targets and their chips."""

    per_strip: int = 12
    check_points_per_strip: int = 20  # known to `truth/` alone
    sigma_m: tuple[float, float, float] = (0.10, 0.10, 0.20)  # 1 sigma east, north, up of the survey
    chip_size_px: int = 128  # side of the chip, in pixels of the strip
    chip_pixel: float = 0.5  # chip's ground pixel / strip's
    chip_mtf_nyquist: float = 0.25  # sharper than the strip, at the chip's own Nyquist frequency
    chip_noise_dn: float = 1.0
    least_texture_dn: float = 6.0  # standard deviation a chip must have, or another place is drawn


@record(by_value=True)
class ErrorSettings:
    """The paper's Table 1. Each may be zero."""

    gps_m: float = 2.0  # 1 sigma of each axis, constant over a strip, another draw for the next
    vibration_arcsec: float = 0.1  # rms of each axis, sines in the band below
    vibration_hz: tuple[float, float] = (30.0, 80.0)
    clock_s: float = 1.0e-4  # 1 sigma of the rows' time against orbit and star camera, one draw a strip
    distortion_px: float = 0.3  # rms, along and across the detectors, of the table's smooth error
    distortion_length_px: float = 1500.0  # its correlation length
    # rms of what each CCD has for itself, along and across it: constant, linear and quadratic in its samples;
    # not given: `OF_DISTORTION` of distortion_px
    ccd_shift_px: float | None = None
    ccd_slope_px: float | None = None
    ccd_bend_px: float | None = None

    @property
    def ccd_px(self) -> tuple[float, float, float]:
        """Shift, slope and bend."""
        usual = OF_DISTORTION * self.distortion_px
        given = (self.ccd_shift_px, self.ccd_slope_px, self.ccd_bend_px)
        shift, slope, bend = (usual if one is None else one for one in given)
        return shift, slope, bend


@record(by_value=True)
class Scenario:
    """Everything that a simulated mission is made from, apart from the seed."""

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid")  # of its tables, too

    name: str
    epoch_utc: str = "2024-11-20T03:40:00"  # time zero; the Sun stands far from the zenith
    orbit: OrbitSettings = OrbitSettings()
    attitude: PointingSettings = PointingSettings()
    installation: InstallationSettings = InstallationSettings()
    star_camera: StarCameraSettings = StarCameraSettings()
    sky: SkySettings = SkySettings()
    line_camera: LineCameraSettings = LineCameraSettings()
    strips: StripSettings = StripSettings()
    sky_strips: SkyStripSettings = SkyStripSettings()
    terrain: TerrainSettings = TerrainSettings()
    ground: GroundSettings = GroundSettings()
    targets: TargetSettings = TargetSettings()
    errors: ErrorSettings = field(default_factory=ErrorSettings)

    def __post_init__(self) -> None:
        _check(self)

    @property
    def ground_pixel_m(self) -> float:
        """Size on the ground of a pixel of the strip, across track, near nadir."""
        camera = self.line_camera
        return camera.pixel_um * 1e-6 / camera.focal_m * self.orbit.altitude_km * 1e3


def paper_scenario() -> Scenario:
    """Tables 1-3 at full size: 5120 x 3840 px at 5 Hz, 4 CCDs x 6144 px x 26000 rows, Table 1's errors."""
    return Scenario(name="paper")


def mini_scenario() -> Scenario:
    """Two fields of view as in the paper, with 1/5 and 1/12 of the pixels across: a dump of some 20 MB."""
    return Scenario(
        name="mini",
        star_camera=StarCameraSettings(
            pixel_um=32.0, width_px=1024, height_px=768, principal_px=(512.0, 384.0), exposure_s=0.1
        ),
        sky=SkySettings(
            flux_v0_e_per_s=1.5e7, psf_sigma_px=1.0, psf_sigma_corner_px=1.0, hot_pixels=40, cosmic_rays=2
        ),
        line_camera=LineCameraSettings(
            pixel_um=120.0,
            samples=512,
            principal_sample=255.0,
            overlap_px=24.0,
            distortion_um=((5.0, 1077.2), (17.0, 866.3)),
            distortion_nodes=33,
        ),
        strips=StripSettings(lines=2000, row_period_s=0.9e-3),
        terrain=TerrainSettings(spacing_arcsec=6.0),
        ground=GroundSettings(texels_per_pixel=2.0, parcel_m=220.0),
        targets=TargetSettings(sigma_m=(0.3, 0.3, 0.5), chip_size_px=96),
        errors=ErrorSettings(distortion_px=0.03, distortion_length_px=125.0),
    )


def sky_scenario() -> Scenario:
    """One scan of the Pleiades with few pixels and no strip of the ground: a dump of some 2 MB."""
    mini = mini_scenario()
    return replace(
        mini,
        name="sky",
        star_camera=replace(
            mini.star_camera,
            pixel_um=64.0,
            width_px=512,
            height_px=384,
            principal_px=(256.0, 192.0),
            rate_hz=2.5,
        ),
        sky=replace(mini.sky, flux_v0_e_per_s=3e7, hot_pixels=10, cosmic_rays=1, read_noise_dn=1.0),
        strips=replace(mini.strips, count=0),
        sky_strips=SkyStripSettings(
            scans=(SkyScan(56.75, 24.12, 2380.0),),
            lines=2000,
            row_period_s=1.8e-3,
            flux_v0_e_per_s=2e9,
            hot_columns=4,
            cosmic_rays=2,
        ),
        ground=replace(mini.ground, read_noise_dn=0.5),
    )


# Functions that make a scenario, by its name.
_BUILTIN = types.MappingProxyType({"mini": mini_scenario, "paper": paper_scenario, "sky": sky_scenario})


def builtin_scenario_names() -> tuple[str, ...]:
    """Names of the scenarios that need no file."""
    return tuple(_BUILTIN)


def builtin_scenario(name: str) -> Scenario:
    """The built-in scenario of that name; `ScenarioError` when there is none."""
    if name not in _BUILTIN:
        raise ScenarioError(f"scenario {name!r} is unknown; built in are {', '.join(_BUILTIN)}")
    return _BUILTIN[name]()


def scenario_from_dict(values: dict[str, Any]) -> Scenario:
    """A scenario from nested tables, as TOML gives them.

    The key `based_on` names a built-in scenario (`paper` when left out) whose settings hold wherever the
    tables say nothing. A list of tables replaces the whole list. `ScenarioError` names the key (dotted),
    what was found and what is expected, for an unknown key as for a value of the wrong type.
    """
    values = dict(values)
    based_on = values.pop("based_on", "paper")
    if not isinstance(based_on, str):
        raise ScenarioError(f"based_on: expected a name, found {value_text(based_on)}")
    merged = _merged(_codec().dump_python(builtin_scenario(based_on), mode="json"), values, "")
    try:
        return _codec().validate_json(json.dumps(merged, default=str), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "value_error":  # of `_check`
            raise first["ctx"]["error"] from None
        where = "".join(f".{part}" if isinstance(part, str) else f"[{part}]" for part in first["loc"])
        says = "expected a value" if first["type"] == "missing" else first["msg"]
        says = says.replace("Input should be", "expected").replace(
            "Unexpected keyword argument", "unknown setting"
        )
        raise ScenarioError(f"{where[1:]}: {says}, found {value_text(first['input'])}") from error


def scenario_to_dict(scenario: Scenario) -> dict[str, Any]:
    """Nested tables of plain values, tuples as lists: what `scenario_from_dict` takes. Without scans of the
    sky there is no table for them; what is not given is left out."""
    without = None if scenario.sky_strips.scans else {"sky_strips"}
    plain: dict[str, Any] = _codec().dump_python(scenario, mode="json", exclude=without, exclude_none=True)
    return plain


@cache
def _codec() -> TypeAdapter[Scenario]:
    return TypeAdapter(Scenario)


def _merged(base: dict[str, Any], values: Any, path: str) -> dict[str, Any]:
    """Tables with the given values in place of their own."""
    if not isinstance(values, dict):
        raise ScenarioError(f"{path or 'scenario'}: expected a table, found {value_text(values)}")
    merged = dict(base)
    for key, value in values.items():
        where = f"{path}.{key}" if path else key
        if key not in base:
            raise ScenarioError(f"{where}: unknown setting; expected one of {', '.join(sorted(base))}")
        merged[key] = _merged(base[key], value, where) if isinstance(base[key], dict) else value
        _check_numbers(value, where)
    return merged


def _check_numbers(value: Any, where: str) -> None:
    """Refuse what no setting comes near, of which pydantic would tell no key: NaN, integers of any length."""
    too_large = isinstance(value, (int, float)) and not abs(value) <= LARGEST
    _refuse(too_large, where, f"a number up to {LARGEST:g}", value)
    for one in value.values() if isinstance(value, dict) else value if isinstance(value, list) else ():
        _check_numbers(one, where)


# Settings that are positive.
_POSITIVE = (
    *("orbit.altitude_km", "orbit.oem_step_s", "star_camera.focal_mm", "star_camera.width_px"),
    *("star_camera.height_px", "star_camera.exposure_s", "sky.psf_sigma_px", "sky.e_per_dn"),
    *("line_camera.focal_m", "line_camera.ccds", "line_camera.samples", "sky_strips.lines"),
    *("sky_strips.row_period_s", "sky_strips.psf_sigma_px", "strips.lines", "strips.row_period_s"),
    *("ground.texels_per_pixel", "ground.parcel_m", "ground.e_per_dn", "targets.chip_size_px"),
    "targets.chip_pixel",
)


def _check(scenario: Scenario) -> None:
    """Values that no mission can have; the message names the setting."""
    camera, sky, line, strips = scenario.star_camera, scenario.sky, scenario.line_camera, scenario.strips
    ground, targets = scenario.ground, scenario.targets
    for name in _POSITIVE:
        _refuse(not (value := attrgetter(name)(scenario)) > 0, name, "a positive number", value)
    without = not strips.count + len(scenario.sky_strips.scans) > 0
    _refuse(without, "strips.count", "a positive number", strips.count)
    for name, bits in (("sky.bits", sky.bits), ("ground.bits", ground.bits)):
        _refuse(not 8 <= bits <= 16, name, "8 to 16", bits)
    if camera.exposure_s * camera.rate_hz > 1.0:
        _refuse(True, "star_camera.exposure_s", f"at most {1 / camera.rate_hz} s", camera.exposure_s)
    turned = len(line.rotation_urad)
    _refuse(turned != line.ccds, "line_camera.rotation_urad", f"{line.ccds} values", turned)
    needed = strips.lines * strips.row_period_s + 2.0 * strips.exposure_lead_s
    longer = f"more than a strip and its exposures last, {needed:.3f} s"
    _refuse(strips.count > 1 and strips.spacing_s <= needed, "strips.spacing_s", longer, strips.spacing_s)
    _check_scans(scenario)
    for wave in scenario.attitude.waves:
        _refuse(
            wave.axis not in ("roll", "pitch", "yaw"), "attitude.waves.axis", "roll, pitch or yaw", wave.axis
        )
    for name, nyquist in (("ground.mtf_nyquist", ground.mtf_nyquist), ("chip", targets.chip_mtf_nyquist)):
        _refuse(not 0.0 < nyquist < 1.0, name, "a value between 0 and 1", nyquist)


def _refuse(is_wrong: bool, name: str, expected: str, found: object) -> None:
    if is_wrong:
        raise ScenarioError(f"{name}: expected {expected}, found {value_text(found)}")


def _check_scans(scenario: Scenario) -> None:
    """Scans of the sky that overlap in time with another strip, or stand still."""
    strips, sky = scenario.strips, scenario.sky_strips
    lead = strips.exposure_lead_s
    duration_s = strips.lines * strips.row_period_s
    starts = [(strips.first_s + n * strips.spacing_s, duration_s) for n in range(strips.count)]
    starts += [(scan.at_s, sky.lines * sky.row_period_s) for scan in sky.scans]
    for (first, duration), (second, _) in pairwise(sorted(starts)):
        if sky.scans and second - lead <= first + duration + lead:
            found = f"one at {first} s that lasts {duration:.3f} s and one at {second} s"
            after = "strips and their exposures one after another"
            raise ScenarioError(f"sky_strips.scans.at_s: expected {after}, found {found}")
    for n, scan in enumerate(sky.scans):
        _refuse(scan.rate == 0.0, f"sky_strips.scans[{n}].rate", "pixels a row, not zero", 0)
