"""`boresight star-camera-plan [IMAGE]`: where to look to calibrate the camera that took an image, or one that
is not yet built.

All brightness of such a one follows from one number, the limiting magnitude: a star of it has the SNR 5.5 in
a matched filter, the detection limit of an image with one false star in two frames. With the noise of a pixel
in electrons the photon noise of brighter stars follows, too.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from astropy.coordinates import get_sun
from astropy.time import Time
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.features.sky_images.identify_images import read_camera, read_sky_image, sky_index
from boresight.features.sky_images.sky_plan import SkyPlan, StarImageModel, plan_pointings
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.console.arguments import option
from boresight.pipeline.console.messages import DATA_DID_NOT_ALLOW, DONE, LIMIT_MISSED
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files.text_tables import table_csv
from boresight.pipeline.files.whole_file import write_figure, write_text
from boresight.pipeline.report.panels import GREY, INK, OURS, THIRD, panels
from boresight.records.record import record
from boresight.star_id.field import nominal_camera, ra_dec_roll, solve_field
from boresight.star_id.finding.psf import Psf
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.settings import StarSettings

__all__ = ["CameraNumbers", "SkyPlanRequest", "camera_of_numbers", "images_of_numbers", "plan_sky"]

# SNR of a star of the limiting magnitude: the detection limit of images of a megapixel
# (`false_alarms_per_frame` 0.5).
LIMIT_SNR = 5.5


@record(by_value=True)
class CameraNumbers:
    """The design of a camera; field of view or focal length, and pitch with the latter."""

    size_px: tuple[int, int] | None = option(
        "Without image: columns and rows of the detector.", None, "--size", metavar="COLUMNS ROWS"
    )
    fov_deg: float | None = None  # along the columns' direction
    focal_mm: float | None = option("Without image, in place of --fov: focal length, mm.", min=1e-3)
    pixel_um: float | None = option("With --focal-mm: pitch of the pixels, micrometres.", min=1e-3)
    limit_mag: float | None = option(f"Without image: magnitude V of stars of SNR {LIMIT_SNR:g}.")
    psf_sigma_px: float = option("Without image: 1-sigma width of the stars, px.", 1.0, min=0.2, max=20.0)
    noise_e: float = option("Without image: noise of a pixel (read noise, sky), electrons.", 10.0, min=0.1)
    full_e: float | None = option("Without image: electrons that fill a pixel.", min=1.0)


def camera_of_numbers(numbers: CameraNumbers, given: StarCamera | None) -> StarCamera:
    """The camera of a design without distortion, or the one given in its place.

    `RawDataError` names the option that is missing, superfluous or out of range.
    """
    if given is not None:
        if numbers.size_px or numbers.focal_mm or numbers.pixel_um or numbers.fov_deg:
            raise RawDataError("--camera", "and --size, --fov, --focal-mm", "both", "one of them")
        return given
    if numbers.size_px is None:
        raise RawDataError(
            "--size", "value", "nothing", "columns and rows of the detector, such as 2048 2048, or an image"
        )
    if min(numbers.size_px) < 32:
        raise RawDataError("--size", "value", f"{numbers.size_px}", "at least 32 pixels a side")
    if (numbers.fov_deg is None) == (numbers.focal_mm is None):
        found = "both" if numbers.fov_deg is not None else "neither"
        raise RawDataError("--fov and --focal-mm", "options", found, "one of them")
    if numbers.pixel_um is not None and numbers.focal_mm is None:
        raise RawDataError("--pixel-um", "option", "with --fov", "with --focal-mm only")
    if numbers.fov_deg is not None:
        if not 0.5 < numbers.fov_deg < 90.0:
            raise RawDataError("--fov", "value", f"{numbers.fov_deg}", "between 0.5 and 90 degrees")
        return nominal_camera(numbers.size_px, math.radians(numbers.fov_deg))
    assert numbers.focal_mm is not None
    if numbers.pixel_um is None:
        raise RawDataError("--pixel-um", "value", "nothing", "the pitch of the pixels, beside --focal-mm")
    width, height = numbers.size_px
    return StarCamera(
        focal_m=1e-3 * numbers.focal_mm,
        pixel_m=1e-6 * numbers.pixel_um,
        width_px=width,
        height_px=height,
        principal_px=(0.5 * (width - 1), 0.5 * (height - 1)),
    )


def images_of_numbers(numbers: CameraNumbers, camera: StarCamera) -> StarImageModel:
    """Brightness and noise of stars in that camera, in electrons (1 e-/DN).

    `RawDataError` without a limiting magnitude.
    """
    if numbers.limit_mag is None:
        expected = f"the magnitude V of stars of SNR {LIMIT_SNR:g}, or an image of the sky"
        raise RawDataError("--limit-mag", "value", "nothing", expected)
    sigma = numbers.psf_sigma_px
    # flux of SNR 1 in a matched filter: noise times the root of the PSF's effective area
    faintest = LIMIT_SNR * numbers.noise_e * math.sqrt(4.0 * math.pi) * sigma
    return StarImageModel(
        psf=Psf(sigma, sigma, (0.0, 0.0), camera.width_px, camera.height_px),
        noise_dn=numbers.noise_e,
        gain_e_per_dn=1.0,
        full_dn=math.inf if numbers.full_e is None else numbers.full_e,
        flux_of_v0_dn=faintest * 10.0 ** (0.4 * numbers.limit_mag),
        faintest_dn=faintest,
    )


# Error of the model, px, from which the camera counts as not determined: errors are then those of its prior.
_NOT_DETERMINED_PX = 5.0
_Known = tuple[StarCamera, StarImageModel, StarIndex, str]  # with a line about it


@record(by_value=True)
class SkyPlanRequest:
    """What is known of the camera, how many images are to be taken, and where the plan goes."""

    camera_file: Path | None = None
    fov_deg: float | None = None
    numbers: CameraNumbers = CameraNumbers()  # of a camera without image; its fov_deg is that above
    frames: int = option("Images that are to be taken.", 10, min=1, max=200)
    candidates: int = option("Random pointings to choose from.", 500, min=1, max=20_000)
    wanted_px: float | None = option(
        "Largest error of the model that is enough: exit status 4 if missed.", min=1e-6
    )
    utc: str | None = option("When: keeps away from the Sun.")
    sun_deg: float = option("Least angle between the image's middle and the Sun.", 60.0, min=0.0, max=180.0)
    seed: int = option("Of the random pointings.", 1, min=0)
    out: Path | None = option("CSV file of the pointings.")
    plot: Path | None = option("PNG: the fields, and what will be known.")


def plan_sky(path: Path | None, request: SkyPlanRequest, settings: StarSettings) -> tuple[list[str], int]:
    """Lines to print, and the exit status: 0, 1 without a plan, 4 where `wanted_px` is not reached.

    Without an image, `request.numbers` describe the camera.
    """
    if path is None:
        camera, images, index, line = _by_numbers(request, settings)
    else:
        known = _by_image(path, request, settings)
        if isinstance(known, str):
            return [f"no plan: {path}: {known}"], DATA_DID_NOT_ALLOW
        camera, images, index, line = known
    candidates = Rotation.random(request.candidates, random_state=np.random.default_rng(request.seed))
    lines = [line]
    if request.utc is not None:
        candidates, line = _away_from_the_sun(camera, candidates, request.utc, request.sun_deg)
        lines.append(line)
    if len(candidates) < request.frames:
        few = f"no plan: {len(candidates)} pointings to choose {request.frames} from"
        return [*lines, few], DATA_DID_NOT_ALLOW
    plan = plan_pointings(camera, images, index, settings, candidates, request.frames)
    if plan.pointings[-1].sigma_px > _NOT_DETERMINED_PX:
        most = max(pointing.stars for pointing in plan.pointings)
        none = f"no plan: {most} stars at most in a field do not determine the camera"
        return [*lines, f"{none}: a wider field or fainter stars are needed"], DATA_DID_NOT_ALLOW
    table = _table(camera, plan)
    lines.append("image   RA deg   Dec deg  roll deg  stars   largest error after it, px (random)")
    lines += [
        f"{row.image:5d}  {row.ra_deg:7.2f}  {row.dec_deg:8.2f}  {row.roll_deg:8.2f}  {row.stars:5d}"
        f"   {row.largest_sigma_px:.4f}  ({row.random_sigma_px:.4f})"
        for row in table.itertuples()
    ]
    status = DONE
    if request.wanted_px is not None:
        line, reached = _wanted(plan, request.wanted_px)
        lines.append(line)
        status = DONE if reached else LIMIT_MISSED
    if request.out is not None:
        out = request.out
        write_text(out, table_csv(table))
        lines.append(f"-> {out}")
    if request.plot is not None:
        _draw(camera, plan, table, index, request.plot)
        lines.append(f"-> {request.plot}")
    return lines, status


def _by_image(path: Path, request: SkyPlanRequest, settings: StarSettings) -> _Known | str:
    """The camera that took an image, or why it is not known."""
    given = read_camera(request.camera_file)
    image = read_sky_image(path, given, request.camera_file)
    index = sky_index(given, request.fov_deg, settings)
    fov = None if request.fov_deg is None else float(np.radians(request.fov_deg))
    seen = solve_field(image, index, settings, camera=given, fov_x_rad=fov)
    if isinstance(seen, NotIdentified):
        return seen.reason
    try:
        images = StarImageModel.of(seen, index)
    except ValueError as error:
        return str(error)
    line = f"{seen.matches} stars of {path} give the noise and detection limit of this camera"
    return seen.camera, images, index, line


def _by_numbers(request: SkyPlanRequest, settings: StarSettings) -> _Known:
    """The camera that the options describe."""
    numbers = replace(request.numbers, fov_deg=request.fov_deg)
    camera = camera_of_numbers(numbers, read_camera(request.camera_file))
    images, index = images_of_numbers(numbers, camera), sky_index(None, None, settings)
    line = (
        f"a camera of {camera.width_px} x {camera.height_px} px and {np.degrees(camera.fov_x_rad):.2f} deg,"
        f" in which stars of V = {numbers.limit_mag:g} have SNR {LIMIT_SNR:g}"
    )
    faintest = float(index.stars.v_mag.max())
    if numbers.limit_mag is not None and numbers.limit_mag > faintest:
        line += f"; of stars fainter than V = {faintest:.1f}, where the catalogue ends, none counts"
    return camera, images, index, line


def _wanted(plan: SkyPlan, wanted_px: float) -> tuple[str, bool]:
    """How many images reach an error of the model, px, and whether these do."""
    after = [pointing.sigma_px for pointing in plan.pointings]
    enough = next((n for n, sigma in enumerate(after, start=1) if sigma <= wanted_px), 0)
    if enough:
        return f"{enough} images reach {wanted_px:g} px", True
    # information grows with the number of images
    more = math.ceil(len(after) * (after[-1] / wanted_px) ** 2)
    return (
        f"MISSED: {len(after)} images reach {after[-1]:.4f} px, not {wanted_px:g}; some {more} would",
        False,
    )


def _away_from_the_sun(
    camera: StarCamera, candidates: Rotation, utc: str, least_deg: float
) -> tuple[Rotation, str]:
    with refusing("--utc", "value", "a time such as 2026-11-22T00:00:00Z", found=utc):
        sun = get_sun(Time(utc.removesuffix("Z"), scale="utc", format="isot")).cartesian.xyz.value
    middles = candidates.inv().apply(camera.middle_axes()[:, 2])
    angle = np.degrees(np.arccos(np.clip(middles @ (sun / np.linalg.norm(sun)), -1.0, 1.0)))
    away = angle >= least_deg
    line = f"{int(away.sum())} of {len(candidates)} pointings are {least_deg:g} deg and more from the Sun"
    return candidates[away], line


def _table(camera: StarCamera, plan: SkyPlan) -> pd.DataFrame:
    rows = []
    for number, (pointing, at_random) in enumerate(zip(plan.pointings, plan.random_sigma_px), start=1):
        ra, dec, roll = np.degrees(ra_dec_roll(camera, pointing.R_si))
        quaternion = dict(zip(("qx_si", "qy_si", "qz_si", "qw_si"), pointing.R_si.as_quat(canonical=True)))
        rows.append(
            {
                "image": number,
                "ra_deg": ra,
                "dec_deg": dec,
                "roll_deg": roll,
                **quaternion,
                "stars": pointing.stars,
                "largest_sigma_px": pointing.sigma_px,
                "random_sigma_px": at_random,
            }
        )
    return pd.DataFrame(rows)


def _draw(camera: StarCamera, plan: SkyPlan, table: pd.DataFrame, index: StarIndex, path: Path) -> None:
    """The fields on the sky, numbered, and how the camera becomes known with them."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    figure, ((sky, error),) = panels(1, 2, 3.2, width_ratios=(1.7, 1.0))
    bright = index.stars.v_mag < 4.5
    ra, dec = np.degrees(index.stars.ra_rad[bright]) % 360.0, np.degrees(index.stars.dec_rad[bright])
    sky.scatter(ra, dec, s=1.4 * (5.2 - index.stars.v_mag[bright]) ** 1.6, color=GREY, linewidths=0)
    labels = np.empty((0, 2))
    for number, pointing in enumerate(plan.pointings, start=1):
        outline = _outline(camera, pointing.R_si)
        for x, y in _pieces(outline):
            sky.plot(x, y, color=INK, linewidth=1.0)
        labels = np.vstack([labels, _free_place(np.column_stack(outline), labels)])
        around = {"boxstyle": "circle,pad=0.15", "facecolor": "white", "edgecolor": "0.5", "linewidth": 0.5}
        sky.text(*labels[-1], str(number), ha="center", va="center", fontsize=8, bbox=around)
    sky.set(xlim=(360, 0), ylim=(-90, 90), xlabel="right ascension, deg", ylabel="declination, deg")
    sky.set_xticks(range(0, 361, 60))
    sky.set_yticks(range(-90, 91, 30))
    sky.set_title("fields to take, in this order; stars to V = 4.5", loc="left", fontsize=10)
    error.semilogy(table["image"], table["largest_sigma_px"], "o-", color=OURS, label="these")
    error.semilogy(table["image"], table["random_sigma_px"], "s--", color=THIRD, label="at random, median")
    error.set(xlabel="images taken", ylabel="largest 1 sigma of the model, px an axis")
    error.set_title("what will be known", loc="left", fontsize=10)
    error.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    error.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    error.yaxis.set_minor_formatter(NullFormatter())
    error.legend(frameon=False)
    write_figure(path, figure)


def _free_place(outline: NDArray[Any], taken: NDArray[Any]) -> NDArray[Any]:
    """The point of an outline that is farthest from other labels, and on the map."""
    inside = outline[(np.abs(outline[:, 1]) < 84.0) & (np.abs(outline[:, 0] - 180.0) < 172.0)]
    if len(inside) == 0 or len(taken) == 0:
        return np.asarray((inside if len(inside) else outline)[0])
    apart = np.hypot(*(inside[:, None] - taken[None]).transpose(2, 0, 1)).min(axis=1)
    return np.asarray(inside[apart.argmax()])


def _outline(camera: StarCamera, R_si: Rotation) -> tuple[NDArray[Any], NDArray[Any]]:
    """Right ascension and declination (deg) along the detector's edge."""
    corners = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0]])
    corners = corners * [camera.width_px, camera.height_px] - 0.5
    t = np.linspace(0.0, 1.0, 30)[:, None]
    edge = np.concatenate([(1.0 - t) * here + t * there for here, there in pairwise(corners)])
    x, y, z = R_si.inv().apply(camera.directions_from_pixels(edge)).T
    return np.degrees(np.arctan2(y, x)) % 360.0, np.degrees(np.arcsin(z))


def _pieces(outline: tuple[NDArray[Any], NDArray[Any]]) -> list[tuple[NDArray[Any], NDArray[Any]]]:
    """An outline cut where it leaves the map on one side and comes back on the other."""
    ra, dec = outline
    cuts = np.flatnonzero(np.abs(np.diff(ra)) > 180.0) + 1
    return list(zip(np.split(ra, cuts), np.split(dec, cuts)))
