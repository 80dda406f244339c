"""The page of `boresight identify --report`: what was seen in one star image and why, identified or not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from boresight.features.sky_images.identify_images import Line, bound_words, misshapen_in
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.report.drawing import FILL, MUTED, Axis, Drawing, Figure, Pen, drawn
from boresight.pipeline.report.page_template import template
from boresight.pipeline.report.star_image import Detection, star_detection, star_picture
from boresight.pipeline.report.star_preview import stretched_jpeg
from boresight.records.record import Bools
from boresight.star_id.field import FieldSolution
from boresight.star_id.finding.psf import images_at
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.finding.windows import star_windows

__all__ = ["write_sky_page"]

# What became of a detection, and the words for it.
STATES = {
    "used": "identified",
    "saturated": "not identified, saturated",
    "blended": "not identified, blended with a neighbour",
    "unused": "not identified",
    "rejected": "no star: text, rays, arms of bright stars",
}
# Most identified stars in the page's table; most stars whose residuals about the PSF are drawn.
MOST_MATCHES, STARS_OF_PSF = 300, 40
PSF_SIGMAS = 4.0  # half a side of the pictures of the PSF


def write_sky_page(line: Line, path: Path) -> None:
    """Write the page of one image, readable without a network."""
    assert line.image is not None and line.stars is not None
    found, stars = line.found, line.stars
    image = line.image[:, ::-1] if found is not None and found.mirrored else line.image
    if found is not None and found.stars is not None:
        stars = found.stars
    known = np.zeros(len(stars.snr), dtype=bool)
    if found is not None:
        known[found.detections] = True
    drawings = [_snr_histogram(stars, known)]
    if (psf := _psf(image, stars)) is not None:
        drawings.insert(0, psf)
    if found is not None:
        drawings.append(_residuals(found))
    rows = [] if found is None else _matches(found, stars)
    text = template("sky.html.j2").render(
        name=Path(str(line.record["file"])).name,
        title=f"{found.matches} stars identified" if found is not None else "Not identified",
        reason="" if found is not None else str(line.record["reason"]).partition(": ")[2],
        rejected=f"Not drawn: {stars.hot_pixels} hot pixels.",
        image=_picture(image, stars, known, line),
        states=STATES,
        seen=_seen(stars),
        solution=[] if found is None else _solution(found),
        drawings=drawings,
        matches=rows[:MOST_MATCHES],
        matches_in_all=len(rows),
    )
    write_text(path, text)


def _picture(image: NDArray[Any], stars: StarList, known: Bools, line: Line) -> dict[str, Any]:
    """What the macro `picture` draws."""
    jpeg, shrunk = stretched_jpeg(image)
    found, planets = line.found, {planet.detection: planet.name for planet in line.planets}
    other = np.where(stars.saturated, "saturated", np.where(stars.blended, "blended", "unused"))
    state = np.where(known, "used", other)
    hip = np.zeros(len(state), dtype=np.int64)
    if found is not None:
        hip[found.detections] = found.hip
    names = [f"HIP {star}" if star else planets.get(row, "") for row, star in enumerate(hip)]
    marks = [
        star_detection(round(float(x), 2), round(float(y), 2), snr, str(kind), STATES, name)
        for (x, y), snr, kind, name in zip(stars.xy_px, stars.snr, state, names)
    ]
    marks += [
        Detection(x=round(x, 2), y=round(y, 2), r=0.6, state="rejected", words=STATES["rejected"], name="")
        for x, y in misshapen_in(image, stars).tolist()
    ]
    picture = star_picture(jpeg, shrunk, (image.shape[1], image.shape[0]), marks, STATES)
    identified = picture["counts"]["used"]
    return picture | {"words": f"Star image with {len(state)} detections, {identified} identified"}


def _seen(stars: StarList) -> list[tuple[str, str]]:
    """What the image shows of camera and sky."""
    psf, sky = stars.psf, stars.background
    source = (
        f"estimated from {stars.psf_stars} stars" if stars.psf_stars else "assumed: too few point-like stars"
    )
    shape = "mean image of the stars" if psf.shape is not None else "Gaussian"
    smear = float(np.hypot(*psf.smear_px))
    return [
        ("point spread function", f"{shape}, {source}"),
        ("its width (1σ)", f"{psf.sigma_px:.2f} px, {psf.sigma_corner_px:.2f} px in the corners"),
        ("motion during the exposure", f"{smear:.1f} px" if smear else "none seen"),
        ("coma in the corners", f"{psf.coma_px:.1f} px" if psf.coma_px else "none seen"),
        ("detection limit", f"{stars.threshold:.2f} sigmas of the matched filter"),
        ("sky", f"{sky.level_dn.min():.1f} to {sky.level_dn.max():.1f} DN"),
        ("noise of a pixel", f"{sky.noise_dn.min():.2f} to {sky.noise_dn.max():.2f} DN"),
        ("gain", f"{stars.gain_e_per_dn:.3g} e/DN" if np.isfinite(stars.gain_e_per_dn) else "not seen"),
        ("saturation", f"{stars.saturation_dn:.0f} DN" if np.isfinite(stars.saturation_dn) else "none"),
        ("saturated, blended stars", f"{stars.saturated.sum()}, {stars.blended.sum()}"),
    ]


def _solution(found: FieldSolution) -> list[tuple[str, str]]:
    """Where the image points, and how sure that is."""
    degrees = np.degrees(
        [found.ra_rad, found.dec_rad, found.roll_rad, found.fov_x_rad, found.fov_x_sigma_rad]
    )
    pointing, roll = found.pointing_sigma_rad / ARCSEC, found.roll_sigma_rad / ARCSEC
    camera = found.camera
    rows = [
        ("right ascension, declination", f"{degrees[0]:.5f}°, {degrees[1]:+.5f}° ± {pointing:.2f}″"),
        ("position angle of the up direction", f"{degrees[2]:.4f}° ± {roll:.1f}″"),
        (
            "field of view",
            f"{degrees[3]:.4f}° ± {degrees[4]:.4f}°" if degrees[4] else f"{degrees[3]:.4f}°, given",
        ),
        ("focal length over pixel pitch", f"{camera.focal_m / camera.pixel_m:.1f} px"),
        ("residuals", f"{found.rms_arcsec:.1f}″ rms"),
        ("probability of a false answer", bound_words(found)),
    ]
    if found.mirrored:
        rows.append(("mirror image", "all is stated, and drawn, for its columns reversed"))
    return rows


def _matches(found: FieldSolution, stars: StarList) -> list[tuple[int, str, str, str, str, str, str]]:
    """A row for each identified star, brightest first."""
    sigma = np.sqrt(0.5 * np.trace(stars.cov_px, axis1=1, axis2=2))
    rows = []
    for n in np.argsort(-stars.snr[found.detections], kind="stable"):
        (x, y), (dx, dy), row = found.xy_px[n], found.residual_px[n], found.detections[n]
        numbers = (
            f"{x:.2f}",
            f"{y:.2f}",
            f"{sigma[row]:.3f}",
            f"{stars.snr[row]:.1f}",
            f"{dx:+.3f}",
            f"{dy:+.3f}",
        )
        rows.append((int(found.hip[n]), *numbers))
    return rows


def _psf(image: NDArray[Any], stars: StarList) -> Drawing | None:
    """Mean of bright stars, the PSF that they were fitted with, and the difference; None without stars."""
    usable = np.flatnonzero(~stars.saturated & ~stars.blended)
    some = usable[np.argsort(-stars.snr[usable], kind="stable")][:STARS_OF_PSF]
    radius = max(4, int(np.ceil(PSF_SIGMAS * stars.psf.sigma_px + stars.psf.reach_px)))
    side = 2 * radius + 1
    if len(some) == 0 or min(image.shape) <= side:
        return None
    xy, flux = stars.xy_px[some], stars.flux_dn[some]
    pixels = np.rint(xy).astype(np.int64)
    windows = star_windows(image, pixels, stars.background, radius, stars.saturation_dn)
    model = images_at(stars.psf, windows.middles, windows.offsets(xy), stars.psf.sigma_at(xy), radius).value
    weight = (flux / flux.sum())[:, None]
    mean = (weight * windows.data / flux[:, None]).sum(axis=0).reshape(side, side)
    fitted = (weight * model).sum(axis=0).reshape(side, side)
    figure, top, reach = Figure(1.95, above=15.0), float(mean.max()), radius + 0.5
    for n, (title, values) in enumerate((("stars", mean), ("PSF", fitted), ("difference", mean - fitted))):
        down, place = Axis("" if n else "px", reach, -reach), figure.cell(n, 1, 3, (12.0, 0.0))
        axes = figure.panel(Axis("px", -reach, reach), down, place)
        axes.picture(values, -0.2 * top, top)
        axes.title(title)
    off = float(np.abs(mean - fitted).max()) / top
    text = (
        f"Mean of the {len(some)} brightest stars, weighted by flux, the PSF as fitted to them, and their"
        f" difference, all in one scale: at most {100 * off:.0f} % of the peak."
    )
    return drawn(figure, "psf", text, f"Point spread function. {text}")


def _snr_histogram(stars: StarList, known: Bools) -> Drawing:
    figure, edges = Figure(2.4), np.geomspace(1.0, 10.0, 25)
    if len(stars.snr):
        edges = np.geomspace(max(1.0, 0.9 * stars.snr.min()), 1.1 * stars.snr.max(), 25)
    counts, named = (np.histogram(values, edges)[0] for values in (stars.snr, stars.snr[known]))
    across = Axis("signal-to-noise ratio", float(edges[0]), float(edges[-1]), is_log=True)
    axes = figure.panel(across, Axis("detections", 0.0, 1.05 * max(1.0, *counts)))
    axes.steps(edges, counts, Pen(colour=MUTED, fill=FILL))
    axes.steps(edges, named, Pen(width=1.4))
    text = "All detections (filled) and those identified (line) by signal-to-noise ratio."
    return drawn(figure, "snr", text, f"Histogram. {text}")


def _residuals(found: FieldSolution) -> Drawing:
    figure, camera = Figure(3.3), found.camera
    longest = max(float(np.quantile(np.linalg.norm(found.residual_px, axis=1), 0.95)), 1e-6)
    enlarged = float(f"{0.06 * camera.width_px / longest:.1g}")
    across = Axis("column, px", -0.5, camera.width_px - 0.5)
    axes = figure.panel(across, Axis("row, px", camera.height_px - 0.5, -0.5), aspect=1.0)
    axes.arrows(found.xy_px, found.xy_px + enlarged * found.residual_px)
    text = f"Measured less predicted positions of the identified stars, {enlarged:g} times enlarged."
    return drawn(figure, "residuals", text, f"Arrows over the image. {text}")
