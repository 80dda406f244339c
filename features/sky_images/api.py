"""Star images: stars found and identified, the star camera calibrated."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.display import Outcome, Result, axes_or_new
from boresight.geometry.constants import ARCSEC
from boresight.geometry.record import Bools, Floats, Ints, array, record, scalar
from boresight.geometry.star_camera import StarCamera
from boresight.star_id.camera_calibration import CameraCalibration, SkyFrame, calibrate_camera
from boresight.star_id.field import FieldSolution, nominal_camera, solve_list
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.finding.star_list import find_stars as stars_of_image
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.settings import StarSettings

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

__all__ = ["CameraSolution", "StarSolution", "Stars", "calibrate_star_camera", "find_stars", "identify"]

Image = NDArray[np.generic] | str | Path


@record(kw_only=True)
class Stars(Result):
    """Stars found in one image, brightest first. Row n of every array is the same star."""

    xy_px: Floats = array("N, 2", "centroids (column, row); (0, 0) is the centre of the first pixel")
    cov_px: Floats = array("N, 2, 2", "covariance of the centroids, px²")
    flux_dn: Floats = array("N", "total above the background, DN")
    snr: Floats = array("N", "flux over the error that the background alone causes")
    saturated: Bools = array("N", "some pixel is full")
    blended: Bools = array("N", "displaced by a neighbour or by blooming: not for calibration")
    psf_sigma_px: float = scalar("width of the point spread function, px, 1 sigma")
    size_px: tuple[int, int] = scalar("width and height of the image, px")
    star_list: StarList = scalar("the full record, as the functions of boresight.star_id take it")

    __repr__ = Result.__repr__

    def __len__(self) -> int:
        return len(self.xy_px)

    @property
    def sigma_px(self) -> Floats:
        """(N,) 1-sigma error of each centroid along one axis, px."""
        return np.sqrt(0.5 * np.trace(self.cov_px, axis1=1, axis2=2))

    def summary(self) -> str:
        """Three lines, as `print` shows them."""
        median = f"{np.median(self.sigma_px):.3f}" if len(self) else "-"
        return (
            f"{len(self)} stars in {self.size_px[0]} x {self.size_px[1]} px\n"
            f"PSF sigma {self.psf_sigma_px:.2f} px, median centroid error {median} px\n"
            f"{int(self.saturated.sum())} saturated, {int(self.blended.sum())} blended"
        )

    def table(self) -> pd.DataFrame:
        """One row a star: x_px, y_px, sigma_px, flux_dn, snr, saturated, blended."""
        import pandas as pd

        columns = {"x_px": self.xy_px[:, 0], "y_px": self.xy_px[:, 1], "sigma_px": self.sigma_px}
        columns |= {name: getattr(self, name) for name in ("flux_dn", "snr", "saturated", "blended")}
        return pd.DataFrame(columns)

    def plot(self, ax: Axes | None = None, *, image: NDArray[np.generic] | None = None) -> Axes:
        """Circles at the stars, over the image (H, W) if it is given; blended stars dashed."""
        ax = _sky_axes(ax, self.size_px, image)
        for chosen, style in ((~self.blended, "-"), (self.blended, "--")):
            x, y = self.xy_px[chosen, 0], self.xy_px[chosen, 1]
            ax.scatter(x, y, s=60, facecolors="none", edgecolors="tab:orange", linestyles=style)
        return ax


@record(kw_only=True)
class StarSolution(Outcome):
    """An identified image: pointing and stars. Row n of every array is the same star."""

    ra_deg: float = scalar("right ascension of the image's centre, GCRS axes, deg")
    dec_deg: float = scalar("declination of the image's centre, GCRS axes, deg")
    roll_deg: float = scalar("position angle of the image's up direction at its centre, east of north, deg")
    fov_deg: float = scalar("field of view between the middles of the left and right edges, deg")
    sigma_arcsec: tuple[float, float] = scalar("1-sigma of the pointing per axis and of the roll, arcsec")
    R_si: Rotation = scalar("attitude: GCRS to star-camera frame s")
    cov_s: Floats = array("3, 3", "covariance of a small rotation about the axes of s, rad²")
    hip: Ints = array("M", "Hipparcos numbers of the identified stars")
    xy_px: Floats = array("M, 2", "their centroids (column, row)")
    residual_px: Floats = array("M, 2", "measured minus predicted centroids")
    false_alarm_probability: float = scalar("upper bound of the probability that the identification is wrong")
    camera: StarCamera = scalar("the camera as given, or as fitted to this image")
    stars: Stars = scalar("all stars found in the image, identified or not")

    __repr__ = Result.__repr__

    def summary(self) -> str:
        """Three lines, as `print` shows them."""
        pointing, roll = self.sigma_arcsec
        return (
            f"RA {self.ra_deg:.5f} deg, Dec {self.dec_deg:+.5f} deg (1 sigma {pointing:.2f} arcsec), "
            f"roll {self.roll_deg:.4f} deg ({roll:.1f} arcsec)\n"
            f"{len(self.hip)} of {len(self.stars)} stars identified, field of view {self.fov_deg:.3f} deg\n"
            f"rms residual {np.sqrt((self.residual_px**2).mean()):.3f} px per axis, "
            f"wrong with probability < {self.false_alarm_probability:.0e}"
        )

    def table(self) -> pd.DataFrame:
        """One row an identified star: hip, x_px, y_px, residual_x_px, residual_y_px."""
        import pandas as pd

        columns = {"hip": self.hip, "x_px": self.xy_px[:, 0], "y_px": self.xy_px[:, 1]}
        return pd.DataFrame(
            columns | {"residual_x_px": self.residual_px[:, 0], "residual_y_px": self.residual_px[:, 1]}
        )

    def plot(self, ax: Axes | None = None, *, image: NDArray[np.generic] | None = None) -> Axes:
        """Identified stars, the brightest 30 with Hipparcos numbers, over the image (H, W) if given."""
        ax = _sky_axes(ax, self.stars.size_px, image)
        color = "black" if image is None else "yellow"
        ax.scatter(self.xy_px[:, 0], self.xy_px[:, 1], s=60, facecolors="none", edgecolors=color)
        for hip, (x, y) in zip(self.hip[:30].tolist(), self.xy_px[:30].tolist()):
            ax.annotate(
                str(hip), (x, y), (5, 5), textcoords="offset points", color=color, annotation_clip=True
            )
        return ax


@record(kw_only=True)
class CameraSolution(Outcome):
    """A star camera calibrated by the stars of several images."""

    camera: StarCamera = scalar("focal length, principal point and distortion")
    sigma_focal_px: float = scalar("1-sigma of the focal length, px")
    sigma_principal_px: tuple[float, float] = scalar("1-sigma of the principal point (column, row), px")
    rms_px: float = scalar("root mean square residual along one axis, px")
    images_used: tuple[str, ...] = scalar("names of the images that were identified")
    images_rejected: tuple[tuple[str, str], ...] = scalar("the others, (name, reason)")
    fit: CameraCalibration = scalar("residuals, full covariance and attitudes (boresight.star_id)")

    __repr__ = Result.__repr__

    def summary(self) -> str:
        """Three lines, as `print` shows them."""
        camera = self.camera
        x, y = camera.principal_px
        return (
            f"focal length {camera.focal_m / camera.pixel_m:.3f} +- {self.sigma_focal_px:.3f} px, "
            f"principal point ({x:.2f} +- {self.sigma_principal_px[0]:.2f}, "
            f"{y:.2f} +- {self.sigma_principal_px[1]:.2f}) px\n"
            f"p1 {camera.p1:.3e} /mm, p2 {camera.p2:.3e} /mm, q1 {camera.q1:.3e} /mm², "
            f"q2 {camera.q2:.3e} /mm⁴, q3 {camera.q3:.3e} /mm⁶, {camera.projection}"
            f"{'' if camera.smooth is None else f', smooth distortion of degree {camera.smooth.degree}'}\n"
            f"{len(self.fit.xy_px)} stars of {len(self.images_used)} images, rms residual "
            f"{self.rms_px:.3f} px per axis; {len(self.images_rejected)} images not identified"
            + ("" if self.fit.explained else f"\nno lens model explains {self.fit.unmodelled_px:.3f} px rms")
        )

    def table(self) -> pd.DataFrame:
        """One row a star of the fit: image, x_px, y_px, residual_x_px, residual_y_px, sigma_px."""
        import pandas as pd

        fit = self.fit
        columns = {
            "image": np.array(self.images_used)[fit.frame],
            "x_px": fit.xy_px[:, 0],
            "y_px": fit.xy_px[:, 1],
        }
        residuals = {"residual_x_px": fit.residual_px[:, 0], "residual_y_px": fit.residual_px[:, 1]}
        return pd.DataFrame(columns | residuals | {"sigma_px": fit.sigma_px})

    def plot(self, ax: Axes | None = None, *, magnified: float = 100.0) -> Axes:
        """Residuals over the detector as arrows, drawn `magnified` times."""
        ax = _sky_axes(ax, (self.camera.width_px, self.camera.height_px), None)
        (x, y), (u, v) = self.fit.xy_px.T, magnified * self.fit.residual_px.T
        ax.quiver(x, y, u, v, angles="xy", scale_units="xy", scale=1.0, width=0.002)
        ax.set_title(f"residuals, {magnified:g} times enlarged")
        return ax


def find_stars(
    image: Image,
    *,
    dark: Image | None = None,
    settings: StarSettings = StarSettings(),  # noqa: B008
) -> Stars:
    """Stars of a raw image with centroids and their covariances, brightest first.

    Parameters
    ----------
    image : (H, W) array, or path
        Raw counts, 8 or 16 bits or floating, at least 32 px a side; or a PNG, TIFF, FITS, JPEG or BMP file.
    dark : (H, W) array, or path, optional
        Dark frame of the same camera and exposure time.
    settings : StarSettings
        Detection threshold, PSF, saturation.

    Returns
    -------
    Stars
        `len(stars)`, arrays `xy_px` (N, 2), `cov_px` (N, 2, 2), `flux_dn` (N,), ...; `table()`, `plot()`.

    Raises
    ------
    ValueError
        If the array is not (H, W) or smaller than 32 px.
    RawDataError
        If a file cannot be read.

    Examples
    --------
    >>> import boresight as bs
    >>> stars = bs.find_stars("fixtures/mini/exposures/e0001.png")
    >>> len(stars) > 50, stars.xy_px.shape == (len(stars), 2)
    (True, True)
    """
    pixels = _pixels(image)
    found = stars_of_image(pixels, settings, None if dark is None else _pixels(dark))
    names = ("xy_px", "cov_px", "flux_dn", "snr", "saturated", "blended")
    return Stars(
        **{name: getattr(found, name) for name in names},
        psf_sigma_px=found.psf.sigma_px,
        size_px=(pixels.shape[1], pixels.shape[0]),
        star_list=found,
    )


def identify(
    image: Image | Stars,
    *,
    camera: StarCamera | None = None,
    fov_deg: float | None = None,
    time: str | None = None,
    site: tuple[float, float, float] | None = None,
    settings: StarSettings = StarSettings(),  # noqa: B008
) -> StarSolution | NotIdentified:
    """Where an image of the sky points, and which stars it shows; no prior attitude is needed.

    Parameters
    ----------
    image : (H, W) array, path, or Stars
        A raw image, or what `find_stars` found in it.
    camera : StarCamera, optional
        The calibrated camera. Without it the lens is fitted to this image.
    fov_deg : float, optional
        Width of the field of view, deg, good to 10 %. Without camera and field of view, 5 to 60 deg are
        searched.
    time : str, optional
        Middle of the exposure, UTC, such as "2026-03-01T12:00:00": the Earth's aberration is then removed.
    site : (latitude deg, longitude deg, height m), optional
        Of a camera on the ground, with `time`: refraction is removed, too.
    settings : StarSettings
        Limits of detection and identification.

    Returns
    -------
    StarSolution or NotIdentified
        `NotIdentified` is false and has a `reason`.

    Raises
    ------
    ValueError
        If camera and fov_deg are both given, or a site without time, or fov_deg is not between 0.5 and 90.
    RawDataError
        If a file cannot be read or the time is not covered by the Earth-orientation tables.

    Examples
    --------
    >>> import boresight as bs
    >>> solution = bs.identify("fixtures/mini/exposures/e0001.png", fov_deg=20)
    >>> if solution:
    ...     print(len(solution.hip) > 50, solution.sigma_arcsec[0] < 5)
    True True
    """
    from boresight.features.sky_images.frame_facts import observer_at
    from boresight.features.sky_images.identify_images import sky_index

    if camera is not None and fov_deg is not None:
        raise ValueError("camera and fov_deg exclude one another: the camera knows its field of view")
    if fov_deg is not None and not 0.5 < fov_deg < 90.0:
        raise ValueError(f"fov_deg must be between 0.5 and 90 deg, got {fov_deg}")
    if site is not None and time is None:
        raise ValueError("site needs time: where a place on the Earth points depends on the time")
    stars = image if isinstance(image, Stars) else find_stars(image, settings=settings)
    found = solve_list(
        stars.star_list,
        stars.size_px,
        sky_index(camera, fov_deg, settings),
        settings,
        camera=camera,
        fov_x_rad=None if fov_deg is None else float(np.radians(fov_deg)),
        observer=None if time is None else observer_at(time, site),
    )
    return found if isinstance(found, NotIdentified) else _solution(found, stars)


def calibrate_star_camera(
    images: Sequence[Image | Stars],
    *,
    camera: StarCamera | None = None,
    fov_deg: float | None = None,
    times: Sequence[str] | None = None,
    site: tuple[float, float, float] | None = None,
    settings: StarSettings = StarSettings(),  # noqa: B008
) -> CameraSolution | NotIdentified:
    """Focal length, principal point and distortion of a star camera from images of the sky.

    Parameters
    ----------
    images : sequence of (H, W) arrays, paths, or Stars
        Images of one camera, of different fields or at different roll angles; 20 identified stars are needed,
        ten images are good.
    camera : StarCamera, optional
        A first, nominal camera, focal length good to 10 %; its pixel pitch is kept.
    fov_deg : float, optional
        Width of the field of view, deg, good to 10 %. Without either, the first image that can be identified
        without them gives it, and pixels are taken to be 5 µm wide.
    times : sequence of str, optional
        Middle of each exposure, UTC. Without them the Earth's aberration changes the focal length, by up to
        1e-4 of it.
    site : (latitude deg, longitude deg, height m), optional
        Of a camera on the ground, with `times`: refraction is removed, too.
    settings : StarSettings
        Limits of detection and identification.

    Returns
    -------
    CameraSolution or NotIdentified
        `NotIdentified` is false and has a `reason`.

    Raises
    ------
    ValueError
        If there are no images, they differ in size, or there is not one time for each.
    RawDataError
        If a file cannot be read.

    Examples
    --------
    >>> import boresight as bs
    >>> folder = "fixtures/mini/exposures"
    >>> found = bs.calibrate_star_camera([f"{folder}/e{n:04d}.png" for n in (1, 9, 17, 25)], fov_deg=20)
    >>> found.rms_px < 0.2
    True
    """
    from boresight.features.sky_images.frame_facts import observer_at
    from boresight.features.sky_images.identify_images import sky_index

    names = [str(image) if isinstance(image, str | Path) else f"image {n}" for n, image in enumerate(images)]
    every = [one if isinstance(one, Stars) else find_stars(one, settings=settings) for one in images]
    if len(sizes := {stars.size_px for stars in every}) != 1:
        raise ValueError(f"images must be of one size, got {sorted(sizes)}")
    if times is not None and len(times) != len(every):
        raise ValueError(f"{len(times)} times given for {len(every)} images")
    if camera is None:
        for stars in every if fov_deg is None else ():
            if first := identify(stars, settings=settings):
                fov_deg = first.fov_deg
                break
        if fov_deg is None:
            return NotIdentified(f"none of {len(every)} images can be identified without fov_deg")
        camera = nominal_camera(every[0].size_px, float(np.radians(fov_deg)))
    index = sky_index(None, float(np.degrees(camera.fov_x_rad)), settings)
    observers = [None] * len(every) if times is None else [observer_at(time, site) for time in times]
    frames = [SkyFrame(*one) for one in zip(names, (stars.star_list for stars in every), observers)]
    found = calibrate_camera(frames, camera, index, settings)
    if isinstance(found, NotIdentified):
        return found
    sigma = np.sqrt(np.diag(found.covariance))
    return CameraSolution(
        camera=found.camera,
        sigma_focal_px=float(sigma[0] / found.camera.pixel_m),
        sigma_principal_px=(float(sigma[1]), float(sigma[2])),
        rms_px=found.rms_px,
        images_used=found.frames_used,
        images_rejected=found.frames_refused,
        fit=found,
    )


def _pixels(image: Image) -> NDArray[np.generic]:
    if not isinstance(image, str | Path):
        return np.asarray(image)
    from boresight.pipeline.files.star_images import read_star_image

    return read_star_image(Path(image), str(image))


def _solution(found: FieldSolution, stars: Stars) -> StarSolution:
    assert found.cov_s is not None  # solve_list gives it
    return StarSolution(
        ra_deg=float(np.degrees(found.ra_rad)),
        dec_deg=float(np.degrees(found.dec_rad)),
        roll_deg=float(np.degrees(found.roll_rad)),
        fov_deg=float(np.degrees(found.fov_x_rad)),
        sigma_arcsec=(found.pointing_sigma_rad / ARCSEC, found.roll_sigma_rad / ARCSEC),
        R_si=found.R_si,
        cov_s=found.cov_s,
        hip=found.hip,
        xy_px=found.xy_px,
        residual_px=found.residual_px,
        false_alarm_probability=found.false_alarm_probability,
        camera=found.camera,
        stars=stars,
    )


def _sky_axes(ax: Axes | None, size_px: tuple[int, int], image: NDArray[np.generic] | None) -> Axes:
    """Axes over a detector, row 0 on top, with the image in grey if there is one."""
    ax = axes_or_new(ax)
    if image is not None:
        low, high = np.percentile(np.asarray(image, dtype=float), (1.0, 99.7))
        ax.imshow(np.asarray(image, dtype=float), cmap="gray", vmin=low, vmax=high)
    ax.set(xlim=(-0.5, size_px[0] - 0.5), ylim=(size_px[1] - 0.5, -0.5), aspect="equal")
    ax.set(xlabel="column, px", ylabel="row, px")
    return ax
