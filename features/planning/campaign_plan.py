"""`boresight plan PLAN.toml`: what a calibration campaign will reach, from its information alone."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from dataclasses import field, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from boresight.display import axes_or_new
from boresight.geometry.constants import ARCSEC
from boresight.geometry.gyro import GyroNoise
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump_schema import OF_LOOK_DISTORTION
from boresight.pipeline.files.text_files import toml_tables
from boresight.pipeline.forecast.accuracy import Forecast
from boresight.pipeline.forecast.campaigns import PLAN_DRAWS, SkyPart, compare_campaigns, forecast_of_plan
from boresight.pipeline.run.settings import settings_from_values
from boresight.records.record import check_numbers, record
from boresight.simulator.campaign import CameraPair, StripPlan, installation_by_tilt

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Plan", "PlanForecast", "forecast_plan", "read_plan"]


# Numbers of targets for which the forecast is made.
TARGET_COUNTS = (3, 4, 6, 8, 12, 16, 24, 32, 48)
ALL_ERRORS = "all errors"  # name of the variant in which no error is left out
# Factor of a sigma that cannot be zero, in the forecast without that error (set by hand).
NEGLIGIBLE = 0.01  # of a sigma that cannot be zero
# Numbers of a plan that may be zero.
MAY_BE_ZERO = (
    *("count", "exposure_margin_s", "sigma_px", "sigma_m", "position_m", "clock_s", "distortion_px"),
    *("vibration_arcsec", "motion_arcsec", "random_walk_arcsec", "bias_walk_arcsec_s", "bias_arcsec_s"),
    "white_arcsec",
)
DRAWS = 25  # example strips for each number of targets, which are plotted and not compared


@record(by_value=True)
class PlannedCameras:
    """`[cameras]`: where the star camera looks, and the pixels of both."""

    star_from_zenith_deg: float = 15.0  # in the Y-Z plane of the remote-sensing camera, Z to nadir
    star_focal_mm: float = 100.0
    star_pixel_um: float = 6.4
    star_width_px: int = 5120
    star_height_px: int = 3840
    focal_m: float = 10.0
    pixel_um: float = 10.0
    ccd_px: int = 6144
    n_ccds: int = 4

    def __post_init__(self) -> None:
        _check(self, star_width_px=65_536, star_height_px=65_536, ccd_px=65_536, n_ccds=64)


@record(by_value=True)
class PlannedStrips:
    """`[strips]`: how many, how long, and the star exposures of each."""

    count: int = 8
    duration_s: float = 1.8
    exposures: int = 10
    exposure_margin_s: float = 0.0
    stars: int = 40  # used in each exposure
    star_sigma_px: float = 0.06
    height_km: float = 530.0

    def __post_init__(self) -> None:
        _check(self, count=1_000_000, exposures=1000, stars=1000)


@record(by_value=True)
class PlannedTargets:
    """`[targets]`: how many a strip, where, and how well their positions are measured and known."""

    count: int = 12
    sigma_px: float = 0.3
    across: tuple[float, float] = (-1.0, 1.0)  # part of the field's half width
    along: tuple[float, float] = (0.0, 1.0)  # part of the strip's length
    sigma_m: float = 0.0

    def __post_init__(self) -> None:
        _check(self, count=10_000)
        if not (self.across[0] <= self.across[1] and self.along[0] <= self.along[1]):
            raise ValueError(f"across and along must increase, got {self.across} and {self.along}")


@record(by_value=True)
class PlannedSky:
    """`[sky]`: strips that scan the sky, forward and backward in turn."""

    count: int = 0
    stars: int = 12  # in each strip
    sigma_px: float = 0.1  # of their places, each axis
    duration_s: float = 7.2
    exposures: int = 36
    rate_mrad_s: float = 3.6  # of the scan: rows last the longer, the slower it is

    def __post_init__(self) -> None:
        _check(self, exposures=1000, stars=1000)
        if not 0 <= self.count <= 1_000_000:
            raise ValueError(f"count must be 0 to 1000000, got {self.count}")


@record(by_value=True)
class PlannedGyro:
    """`[gyro]`: a gyro between the star exposures of strips of the ground, the same about every axis."""

    random_walk_arcsec: float = 0.0  # 1-sigma after one second; 0: there is no gyro
    bias_walk_arcsec_s: float = 1e-4  # 1-sigma by which the bias changes in one second
    bias_arcsec_s: float = 200.0  # 1-sigma of the bias
    white_arcsec: float = 0.01  # 1-sigma of an angle by itself, its resolution
    step_s: float = 0.1  # from row to row

    def __post_init__(self) -> None:
        _check(self)
        if not 1e-3 <= self.step_s <= 100.0:
            raise ValueError(f"step_s must be 0.001 to 100, got {self.step_s}")

    @property
    def noise(self) -> GyroNoise | None:
        """Its errors; None without a gyro. `ValueError` unless all are positive."""
        sizes = self.bias_walk_arcsec_s, self.bias_arcsec_s, self.white_arcsec
        walk, drift, bias, white = (ARCSEC * size for size in (self.random_walk_arcsec, *sizes))
        if not self.random_walk_arcsec:
            return None
        return GyroNoise(random_walk_rad=walk, bias_walk_rad_s=drift, bias_rad_s=bias, white_rad=white)


@record(by_value=True)
class PlannedErrors:
    """`[errors]`: 1-sigma of what is common to a strip or a camera (defaults: the paper's Table 1)."""

    position_m: float = 2.0
    clock_s: float = 1e-4
    vibration_arcsec: float = 0.1
    motion_arcsec: float = 6.0
    motion_s: float = 0.8
    distortion_px: float = 0.3
    distortion_length_px: float = 2000.0

    def __post_init__(self) -> None:
        _check(self)


@record(by_value=True)
class Plan:
    """A campaign as its file describes it; every section and key is optional."""

    cameras: PlannedCameras = field(default_factory=PlannedCameras)
    strips: PlannedStrips = field(default_factory=PlannedStrips)
    targets: PlannedTargets = field(default_factory=PlannedTargets)
    sky: PlannedSky = field(default_factory=PlannedSky)
    gyro: PlannedGyro = field(default_factory=PlannedGyro)
    errors: PlannedErrors = field(default_factory=PlannedErrors)


@record
class PlanForecast:
    """1-sigma against the number of strips and of targets, and without each source of error (long form), a
    summary, and the strips that a target needs.
    """

    table: pd.DataFrame
    by_targets: pd.DataFrame  # targets a strip, axis, sigma_arcsec
    without: pd.DataFrame  # source of error, axis, sigma_arcsec without it
    campaigns: pd.DataFrame  # ground, sky, both: axis, sigma_arcsec; no rows without strips of the sky
    text: str
    strips_needed: int | None

    def __repr__(self) -> str:
        return self.text

    def plot(self, ax: Axes | None = None) -> Axes:
        """1-sigma about each axis against the number of strips; dotted, what no number of them goes below."""
        ax = axes_or_new(ax)
        for axis, rows in self.table.groupby("axis"):
            (line,) = ax.plot(rows["strips"], rows["sigma_arcsec"], label=str(axis))
            if (floor := float(rows["floor_arcsec"].iloc[0])) > 0.0:
                ax.axhline(floor, color=line.get_color(), linestyle=":")
        ax.set(xscale="log", yscale="log", xlabel="strips", ylabel="predicted 1 sigma, arcsec")
        ax.legend()
        return ax

    def _repr_html_(self) -> str:
        head = self.table.head(9).to_html(border=0, float_format="{:.6g}".format)
        return f"<pre>{html.escape(self.text)}</pre>{head}"


def read_plan(path: Path) -> Plan:
    """The plan of a TOML file; `RawDataError` names what it does not know."""
    return settings_from_values(Plan, toml_tables(path, str(path)), str(path), "plan")


def forecast_plan(plan: Plan, target_arcsec: float | None = None) -> PlanForecast:
    """Predicted 1-sigma of theta by number of strips; `DataNotSufficientError` if it fails."""
    try:
        campaign, cameras = _campaign(plan)
        forecast = cache(partial(forecast_of_plan, cameras=cameras, draws=PLAN_DRAWS))
        with np.errstate(over="raise", invalid="raise"):
            found = forecast(campaign)
    except (ValueError, ArithmeticError) as error:
        raise DataNotSufficientError(f"this campaign cannot be forecast: {error}") from error
    counts = np.unique(np.append(np.geomspace(1, 1000, 31).astype(int), plan.strips.count))
    floor = found.floor() / ARCSEC
    rows = [
        (int(n), "XYZ"[axis], sigma / ARCSEC, floor[axis])
        for n in counts
        for axis, sigma in enumerate(found.sigma(int(n)))
    ]
    table = pd.DataFrame(rows, columns=["strips", "axis", "sigma_arcsec", "floor_arcsec"])
    needed = None if target_arcsec is None else found.strips_for(target_arcsec * ARCSEC)
    targets = {n: replace(campaign, targets=n) for n in TARGET_COUNTS}
    by_targets = _sigmas(plan, "targets", targets, partial(forecast_of_plan, cameras=cameras, draws=DRAWS))
    without = _sigmas(plan, "source", _without(campaign), forecast)
    campaigns = _campaigns(plan, campaign, cameras)
    lines = [
        _text(plan, found, target_arcsec, needed),
        *_limit_lines(without),
        *_campaign_lines(plan, campaigns),
    ]
    return PlanForecast(table, by_targets, without, campaigns, "\n".join(lines), needed)


def _campaigns(plan: Plan, campaign: StripPlan, cameras: CameraPair) -> pd.DataFrame:
    """1-sigma of the ground's strips alone, the sky's alone, and both; no rows without strips of the sky."""
    rows: list[tuple[str, str, float]] = []
    if (sky := plan.sky).count:
        strip = replace(
            campaign,
            targets=sky.stars,
            sigma_c_px=sky.sigma_px,
            duration_s=sky.duration_s,
            exposures=sky.exposures,
            across=(-1.0, 1.0),
            along=(0.0, 1.0),
        )
        part = SkyPart(strip, sky.count, 1e-3 * sky.rate_mrad_s)
        for name, sigma in compare_campaigns(campaign, part, cameras).items():
            rows += [(name, axis, value / ARCSEC) for axis, value in zip("XYZ", sigma)]
    return pd.DataFrame(rows, columns=["campaign", "axis", "sigma_arcsec"])


def _campaign_lines(plan: Plan, campaigns: pd.DataFrame) -> list[str]:
    """The campaigns beside one another."""
    names = {
        "ground": f"{plan.strips.count} strips of the ground",
        "sky": f"{plan.sky.count} strips of the sky",
        "both": "both together",
    }
    lines = []
    for name, text in names.items():
        those = campaigns[campaigns["campaign"] == name]
        if len(those):
            pairs = zip(those["axis"], those["sigma_arcsec"])
            lines.append(f"{text:28s}" + "  ".join(f"{axis} {sigma:.4g}″" for axis, sigma in pairs))
    return lines


def _without(campaign: StripPlan) -> dict[str, StripPlan]:
    """The campaign without one source of error after the other."""
    return {
        ALL_ERRORS: campaign,
        "position": replace(campaign, sigma_position_m=0.0),
        "clock": replace(campaign, sigma_clock_s=0.0),
        "vibration": replace(campaign, sigma_vibration_rad=0.0),
        "distortion": replace(campaign, sigma_distortion_rad=0.0, sigma_ccd_rad=(0.0, 0.0, 0.0)),
        "targets": replace(campaign, sigma_c_px=NEGLIGIBLE * campaign.sigma_c_px, sigma_target_m=0.0),
        "stars": replace(campaign, sigma_s_px=NEGLIGIBLE * campaign.sigma_s_px),
    }


def _sigmas(
    plan: Plan, name: str, campaigns: Mapping[Any, StripPlan], forecast: Callable[[StripPlan], Forecast]
) -> pd.DataFrame:
    """1-sigma after the plan's strips of variants of a campaign; NaN where an axis is not observable."""
    rows = []
    for key, campaign in campaigns.items():
        try:
            sigma = forecast(campaign).sigma(plan.strips.count) / ARCSEC
        except (ValueError, ArithmeticError):
            sigma = np.full(3, np.nan)
        rows += [(key, axis, value) for axis, value in zip("XYZ", sigma)]
    return pd.DataFrame(rows, columns=[name, "axis", "sigma_arcsec"])


def _limit_lines(without: pd.DataFrame) -> list[str]:
    """For each axis the source of error without which it would be known best."""
    lines = []
    for axis in "XYZ":
        those = without[without["axis"] == axis]
        sigmas = dict(zip(those["source"], those["sigma_arcsec"].fillna(np.inf)))
        best, every = min(sigmas, key=lambda name: float(sigmas[name])), sigmas[ALL_ERRORS]
        if sigmas[best] < every:
            lines.append(f"{axis} is limited by: {best} ({every:.4g}″, without {sigmas[best]:.4g}″)")
    return lines


def _check(record: object, **most: int) -> None:
    """`ValueError` for counts that are not 1 to `most`, and for numbers that no campaign has."""
    for name, limit in most.items():
        if not 1 <= getattr(record, name) <= limit:
            raise ValueError(f"{name} must be 1 to {limit}, got {getattr(record, name)}")
    check_numbers(record, zero=MAY_BE_ZERO, any_value=("star_from_zenith_deg",))


def _campaign(plan: Plan) -> tuple[StripPlan, CameraPair]:
    c, s, t, e = plan.cameras, plan.strips, plan.targets, plan.errors
    pixel_rad = c.pixel_um * 1e-6 / c.focal_m
    cameras = CameraPair(
        R_cs=installation_by_tilt(np.radians(c.star_from_zenith_deg)),
        star_pixel_rad=c.star_pixel_um / c.star_focal_mm * 1e-3,
        star_half_width_px=0.5 * c.star_width_px,
        star_half_height_px=0.5 * c.star_height_px,
        pixel_rad=pixel_rad,
        ccd_px=c.ccd_px,
        n_ccds=c.n_ccds,
    )
    campaign = StripPlan(
        strips=s.count,
        duration_s=s.duration_s,
        exposures=s.exposures,
        exposure_margin_s=s.exposure_margin_s,
        stars=s.stars,
        targets=t.count,
        across=t.across,
        along=t.along,
        sigma_s_px=s.star_sigma_px,
        sigma_c_px=t.sigma_px,
        height_m=s.height_km * 1e3,
        sigma_position_m=e.position_m,
        sigma_clock_s=e.clock_s,
        sigma_vibration_rad=e.vibration_arcsec * ARCSEC,
        sigma_motion_rad=e.motion_arcsec * ARCSEC,
        motion_time_s=e.motion_s,
        sigma_distortion_rad=e.distortion_px * pixel_rad,
        distortion_length_px=e.distortion_length_px,
        distortion_pixel_rad=pixel_rad,
        sigma_ccd_rad=(OF_LOOK_DISTORTION * e.distortion_px * pixel_rad,) * 3,
        sigma_target_m=t.sigma_m,
        gyro=plan.gyro.noise,
        gyro_step_s=plan.gyro.step_s,
    )
    return campaign, cameras


def _text(plan: Plan, found: Forecast, target_arcsec: float | None, needed: int | None) -> str:
    def angles(sigma: np.ndarray) -> str:
        shown = [
            f"{axis} {s:.4g}″" if np.isfinite(s) else f"{axis} not observable"
            for axis, s in zip("XYZ", sigma)
        ]
        return "  ".join(shown)

    lines = [
        f"{plan.strips.count} strips: 1-sigma  {angles(found.sigma(plan.strips.count) / ARCSEC)}",
        f"never below:  {angles(found.floor() / ARCSEC)}",
    ]
    for d in found.after(plan.strips.count).unobservable:
        lines.append(f"the rotation about [{d[0]:+.3f} {d[1]:+.3f} {d[2]:+.3f}] (frame c) is not observable")
    if target_arcsec is not None and needed is not None:
        lines.append(f"{needed} strips bring every axis to {target_arcsec:g}″")
    elif target_arcsec is not None:
        lines.append(
            f"no number of strips brings every axis to {target_arcsec:g}″: what strips share, the camera's "
            f"distortion, does not average; calibrate it better, or spread the targets wider"
        )
    return "\n".join(lines)
