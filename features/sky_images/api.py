"""Star images: stars found and identified, the star camera calibrated."""

from __future__ import annotations

import datetime
import os
from collections.abc import Iterable
from dataclasses import replace
from math import degrees
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from boresight import accepted
from boresight.accepted import ImageLike, Progress, SiteLike, TimeLike, no_progress
from boresight.display import Result, SuccessfulResult, axes_or_new
from boresight.features.sky_images.centroid_lists import are_centroids, star_list_of
from boresight.features.sky_images.frame_facts import observer_at
from boresight.features.sky_images.identify_images import bound_words, departure, sky_index, with_unknown_time
from boresight.features.sky_images.image_time import with_error_of_focus
from boresight.features.sky_images.overlay import named_sky
from boresight.features.sky_images.planets import planets_in_view
from boresight.features.sky_images.sip import TanSip, tan_sip
from boresight.features.sky_images.sky_plot import draw_sky
from boresight.geometry.constants import ARCSEC
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.images.star_images import grey_image, read_star_image
from boresight.records.record import Bools, Floats, Ints, inner, record, scalar
from boresight.star_id.camera_calibration import CameraCalibration, SkyFrame, calibrate_camera
from boresight.star_id.field import FieldSolution, nominal_camera, solve_list
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.finding.star_list import list_stars as stars_of_image
from boresight.star_id.identification.identify import NotIdentified
from boresight.star_id.observer import Observer, sky_directions
from boresight.star_id.settings import StarSettings

if TYPE_CHECKING:
    from astropy.coordinates import SkyCoord
    from astropy.wcs import WCS
    from matplotlib.axes import Axes

__all__ = [
    "CameraSolution",
    "StarSolution",
    "Stars",
    "calibrate_star_camera",
    "find_stars",
    "identify",
    "image_pixels",
    "stars_given",
]

NARROWEST_DEG, WIDEST_DEG = 0.5, 175.0  # fields of view that are searched
SMALLEST_PX, MOST_COUNTS = 32, 65535  # side of an image, and its counts
# Largest difference, px, of a TAN-SIP header from the camera for the header to be given; wide fisheye
# lenses have none (set by hand).
MOST_MISFIT_PX = 1.0
LARGEST_PX = 1e6  # of coordinates that are taken to the sky


class _Pixels(NamedTuple):
    """An image as an array, and what is to be said of it."""

    pixels: NDArray[np.generic]
    hidden: Bools | None  # (H, W) pixels that are no number, which the median replaces; None: none
    floating: bool  # the level at which pixels are full is not known


@record(kw_only=True)
class Stars(Result):
    """Stars found in one image, brightest first. Row n of every array is the same star."""

    star_list: StarList = scalar("the full record, as the functions of boresight.star_id take it")
    size_px: tuple[int, int] = scalar("width and height of the image, px")
    masked: int = scalar("pixels without a number: they have no weight")
    pixels: NDArray[Any] | None = scalar("grey values (H, W); None: not given", default=None, repr=False)
    xy_px = inner[Floats](
        "star_list.xy_px", "(N, 2) centroids (column, row); (0, 0) is the centre of the first pixel"
    )
    cov_px = inner[Floats]("star_list.cov_px", "(N, 2, 2) covariance of the centroids, px²")
    flux_dn = inner[Floats]("star_list.flux_dn", "(N,) total above the background, DN")
    snr = inner[Floats]("star_list.snr", "(N,) flux over the error that the background alone causes")
    saturated = inner[Bools]("star_list.saturated", "(N,) some pixel is full")
    blended = inner[Bools](
        "star_list.blended", "(N,) displaced by a neighbour or by blooming: not for calibration"
    )
    psf_sigma_px = inner[float]("star_list.psf.sigma_px", "width of the point spread function, px, 1 sigma")
    misshapen_px = inner[Floats](
        "star_list.misshapen_px",
        "(M, 2) detections that are not among the stars: cosmic rays, trails, stars that touch one another",
    )
    hot_pixels = inner[int]("star_list.hot_pixels", "detections rejected as hot pixels")
    saturation_dn = inner[float](
        "star_list.saturation_dn", "value from which a pixel is full; inf: not known, no star is saturated"
    )

    @classmethod
    def of_centroids(
        cls,
        xy_px: ArrayLike | pd.DataFrame,
        *,
        size_px: tuple[int, int],
        sigma_px: ArrayLike | None = None,
        cov_px: ArrayLike | None = None,
        flux_dn: ArrayLike | None = None,
    ) -> Stars:
        """Stars that another program found.

        Parameters
        ----------
        xy_px : (N, 2) array, or DataFrame
            Centroids (column, row), (0, 0) the centre of the first pixel, brightest first unless `flux_dn` is
            given; or a table with the columns x_px, y_px and, as known, sigma_px (or sigma_x_px, sigma_y_px,
            cov_xy_px2), flux_dn, snr.
        size_px : (width, height)
            Size of the image, px.
        sigma_px : float or (N,) array, optional
            1-sigma errors along either axis, px; 0.2 px where neither they nor `cov_px` are stated.
        cov_px : (N, 2, 2) array, optional
            Covariances, px², instead.
        flux_dn : (N,) array, optional
            Fluxes; only their order counts.

        Raises `ValueError` for other shapes, or numbers that are not finite.

        Examples
        --------
        >>> import boresight as bs
        >>> found = bs.find_stars(bs.example("mini") / "exposures/e0001.png")
        >>> stars = bs.Stars.of_centroids(found.xy_px, size_px=found.size_px)[:40]
        >>> bool(bs.identify(stars, fov_deg=20))
        True
        """
        given = {"sigma_px": sigma_px, "cov_px": cov_px, "flux_dn": flux_dn}
        return cls(star_list=star_list_of(xy_px, size_px, **given), size_px=size_px, masked=0)

    def __len__(self) -> int:
        return len(self.xy_px)

    def __getitem__(self, chosen: Any) -> Stars:
        """The stars of a slice, a mask or an array of indices: `stars[:20]`, `stars[stars.snr > 10]`."""
        return replace(self, star_list=self.star_list.take(np.atleast_1d(np.arange(len(self))[chosen])))

    def __add__(self, other: Stars) -> Stars:
        """The stars of both lists of one image, brightest first."""
        if (more := accepted.instance_of(other, Stars, "other")).size_px != self.size_px:
            raise accepted.wrong("other", f"stars of an image of {more.size_px} px", f"{self.size_px}")
        return replace(self, star_list=self.star_list.joined(more.star_list))

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
            f"{int(self.saturated.sum())} saturated, {int(self.blended.sum())} blended (not for calibration)"
            "\n"
            f"not used: {'; '.join(self.not_used) or 'nothing'}"
        )

    @property
    def not_used(self) -> tuple[str, ...]:
        """What is not among the stars, or not known of them, with the remedy; one sentence each."""
        said = []
        if len(self.misshapen_px):
            said.append(f"{len(self.misshapen_px)} misshapen detections (misshapen_px)")
        if self.hot_pixels:
            said.append(f"{self.hot_pixels} hot pixels")
        if self.masked:
            said.append(f"{self.masked} masked pixels: not a number, without weight")
        if np.isinf(self.saturation_dn):
            remedy = "give StarSettings(saturation_dn=...)"
            said.append(f"float image: saturation level unknown, {remedy}")
        return tuple(said)

    def table(self) -> pd.DataFrame:
        """One row a star: x_px, y_px, sigma_px, flux_dn, snr, saturated, blended."""

        columns = {"x_px": self.xy_px[:, 0], "y_px": self.xy_px[:, 1], "sigma_px": self.sigma_px}
        columns |= {name: getattr(self, name) for name in ("flux_dn", "snr", "saturated", "blended")}
        return pd.DataFrame(columns)

    def plot(self, ax: Axes | None = None, *, image: ImageLike | None = None) -> Axes:
        """Circles at the stars, over the image if it is given; blended stars dashed, misshapen
        detections as crosses.
        """
        ax = _sky_axes(ax, self.size_px, image)
        for chosen, style in ((~self.blended, "-"), (self.blended, "--")):
            x, y = self.xy_px[chosen, 0], self.xy_px[chosen, 1]
            ax.scatter(x, y, s=60, facecolors="none", edgecolors="tab:orange", linestyles=style)
        ax.plot(*self.misshapen_px.T, "x", color="tab:blue", markersize=5)
        return ax


@record(kw_only=True)
class StarSolution(SuccessfulResult):
    """An identified image: pointing and stars. Row n of every array is the same star."""

    field: FieldSolution = scalar(
        "the full record, as the functions of boresight.star_id give it", repr=False
    )
    stars: Stars = scalar("all stars found in the image, identified or not")
    observer: Observer | None = scalar("time and place, where given: aberration is removed", repr=False)
    R_si = inner[Rotation]("field.R_si", "attitude: GCRS to star-camera frame s")
    hip = inner[Ints]("field.hip", "(M,) Hipparcos numbers of the identified stars")
    xy_px = inner[Floats]("field.xy_px", "(M, 2) their centroids (column, row)")
    residual_px = inner[Floats]("field.residual_px", "(M, 2) measured minus predicted centroids")
    false_alarm_probability = inner[float](
        "field.false_alarm_probability", "upper bound of the probability that the identification is wrong"
    )
    camera = inner[StarCamera]("field.camera", "the camera as given, or as fitted to this image")
    misfit_px = inner[float](
        "field.misfit_px", "rms displacement of stars from the camera, an axis, px; 0: none seen"
    )
    mirrored = inner[bool](
        "field.mirrored", "whether the image is a mirror image: all is stated for its columns reversed"
    )
    ra_deg = inner[float]("field.ra_rad", "right ascension of the image's centre, GCRS axes, deg", degrees)
    dec_deg = inner[float]("field.dec_rad", "declination of the image's centre, GCRS axes, deg", degrees)
    roll_deg = inner[float](
        "field.roll_rad",
        "position angle of the image's up direction at its centre, east of north, deg",
        degrees,
    )
    fov_deg = inner[float](
        "field.fov_x_rad", "field of view between the middles of the left and right edges, deg", degrees
    )

    @property
    def sigma_arcsec(self) -> tuple[float, float]:
        """1-sigma of the pointing per axis and of the roll, arcsec."""
        return self.field.pointing_sigma_rad / ARCSEC, self.field.roll_sigma_rad / ARCSEC

    @property
    def cov_s(self) -> Floats:
        """(3, 3) covariance of a small rotation about the axes of s, rad²."""
        assert self.field.cov_s is not None  # solve_list gives it
        return self.field.cov_s

    @property
    def departure(self) -> str:
        """How the stars depart from a camera that was given; empty: not seen."""
        return departure(self.field)

    def pixel_to_sky(self, xy_px: ArrayLike) -> SkyCoord:
        """Right ascension and declination, ICRS, of pixels.

        With a time, aberration, light deflection and refraction are removed, not proper motion and parallax;
        without a time they are the directions of the catalogue that the stars of the image define.

        Parameters
        ----------
        xy_px : (N, 2) or (2,) array
            (column, row) of the image as given; (0, 0) is the centre of the first pixel.

        Returns
        -------
        astropy.coordinates.SkyCoord
            Of shape (N,), or a scalar for one pixel; NaN beyond the turning point of the distortion.

        Raises `ValueError` for another shape or numbers that are not finite.
        """
        xy = accepted.floats_of(xy_px, "xy_px", "(N, 2)")
        if xy.ndim not in (1, 2) or xy.shape[-1] != 2:
            raise accepted.wrong("xy_px", xy, "shape (N, 2) or (2,)")
        if not (np.isfinite(xy).all() and (np.abs(xy) < LARGEST_PX).all()):
            raise accepted.wrong("xy_px", "values that are not finite or beyond a million", "pixels")
        is_single, xy = xy.ndim == 1, self._as_mirrored(np.atleast_2d(xy))
        u_i = sky_directions(self.R_si.inv().apply(self.camera.directions_from_pixels(xy)), self.observer)
        ra, dec = np.degrees(np.arctan2(u_i[:, 1], u_i[:, 0])) % 360.0, np.degrees(np.arcsin(u_i[:, 2]))
        place: SkyCoord = _world().SkyCoord(
            *((ra[0], dec[0]) if is_single else (ra, dec)), unit="deg", frame="icrs"
        )
        return place

    def wcs(self, *, max_misfit_px: float = MOST_MISFIT_PX) -> WCS:
        """World coordinates of the image as an astropy WCS: tangent plane with SIP polynomials of degree 7.

        Its pixels count from 0 as `pixel_to_sky`'s do (`origin` 0 of astropy). `wcs_misfit_px` states the
        largest difference from the camera. `ValueError` where it exceeds `max_misfit_px`: a wide lens has no
        tangent plane; use `pixel_to_sky`.
        """
        limit, header = accepted.number_of(max_misfit_px, "max_misfit_px", 0.0), self._tan_sip()
        if not header.largest_misfit_px <= limit:
            raise accepted.wrong(
                "max_misfit_px",
                f"a misfit of {header.largest_misfit_px:.3g} px of the TAN-SIP form of this lens",
                f"at most {limit:g} px; pixel_to_sky has no such limit",
            )
        wcs: WCS = _world().image_wcs(header, *self.stars.size_px)
        return wcs

    @property
    def wcs_misfit_px(self) -> float:
        """Largest difference of `wcs()` from the camera over the detector, px."""
        return self._tan_sip().largest_misfit_px

    def _tan_sip(self) -> TanSip:
        return tan_sip(
            self.camera,
            self.R_si,
            sky_of=lambda u_i: sky_directions(u_i, self.observer),
            mirrored=self.mirrored,
        )

    def summary(self) -> str:
        """Few lines, as `print` shows them."""
        pointing, roll = self.sigma_arcsec
        return (
            f"RA {self.ra_deg:.5f} deg, Dec {self.dec_deg:+.5f} deg (1 sigma {pointing:.2f} arcsec), "
            f"roll {self.roll_deg:.4f} deg ({roll:.1f} arcsec)\n"
            f"{len(self.hip)} of {len(self.stars)} stars identified, field of view {self.fov_deg:.3f} deg\n"
            f"rms residual {np.sqrt((self.residual_px**2).mean()):.3f} px per axis, "
            f"wrong with probability {bound_words(self.field)}"
            f"{', MIRROR IMAGE: all is stated for its columns reversed' if self.mirrored else ''}\n"
            f"{self.departure + chr(10) if self.departure else ''}"
            f"not used: {'; '.join(self.not_used) or 'nothing'}"
        )

    @property
    def not_used(self) -> tuple[str, ...]:
        """Stars without identification, and what the list of stars does not hold."""
        unnamed = len(self.stars) - len(self.hip)
        return ((f"{unnamed} stars not identified",) if unnamed else ()) + self.stars.not_used

    def table(self) -> pd.DataFrame:
        """One row an identified star: hip, x_px, y_px, residual_x_px, residual_y_px, and the measured ra_deg
        and dec_deg.
        """

        sky = self.pixel_to_sky(self._as_mirrored(self.xy_px))
        columns = {"hip": self.hip, "x_px": self.xy_px[:, 0], "y_px": self.xy_px[:, 1]}
        columns |= {"residual_x_px": self.residual_px[:, 0], "residual_y_px": self.residual_px[:, 1]}
        return pd.DataFrame(columns | {"ra_deg": sky.ra.deg, "dec_deg": sky.dec.deg})

    def _as_mirrored(self, xy_px: Floats) -> Floats:
        """Pixels (N, 2), of a mirror image with its columns reversed: from the image as given to that which
        all is stated for, and back."""
        return xy_px * [-1.0, 1.0] + [self.stars.size_px[0] - 1.0, 0.0] if self.mirrored else xy_px

    def plot(self, ax: Axes | None = None, *, image: ImageLike | None = None) -> Axes:
        """The image as `boresight identify --overlay` draws it, with what is in it named, lines of right
        ascension and declination, north, east and a bar of scale. Of centroids `image` is their image;
        without it, the sky is dark. A mirror image is drawn with its columns reversed.
        """
        pixels = self.stars.pixels if image is None else image_pixels(image, "image")
        width, height = self.stars.size_px
        if pixels is None:
            pixels = np.zeros((height, width), dtype=np.uint8)
        if pixels.shape != (height, width):
            raise accepted.wrong(
                "image", f"shape {pixels.shape}", f"the image of these stars, shape {(height, width)}"
            )
        planets = () if self.observer is None else planets_in_view(self.field, self.observer)
        seen = np.nan_to_num(pixels[:, ::-1] if self.mirrored else pixels)
        picture = named_sky(seen, self.field, planets)

        def sky_of(xy_px: Floats) -> Floats:
            place = self.pixel_to_sky(self._as_mirrored(xy_px))
            return np.column_stack([place.ra.deg, place.dec.deg])

        return draw_sky(axes_or_new(ax), picture, self.stars.size_px, sky_of)


@record(kw_only=True)
class CameraSolution(SuccessfulResult):
    """A star camera calibrated by the stars of several images."""

    fit: CameraCalibration = scalar("residuals, full covariance and attitudes (boresight.star_id)")
    camera = inner[StarCamera]("fit.camera", "focal length, principal point and distortion")
    rms_px = inner[float]("fit.rms_px", "root mean square residual along one axis, px")
    images_used = inner[tuple[str, ...]]("fit.frames_used", "names of the images that were identified")
    images_rejected = inner[tuple[tuple[str, str], ...]]("fit.frames_refused", "the others, (name, reason)")

    @property
    def sigma_focal_px(self) -> float:
        """1-sigma of the focal length, px."""
        return float(np.sqrt(self.fit.covariance[0, 0]) / self.camera.pixel_m)

    @property
    def sigma_principal_px(self) -> tuple[float, float]:
        """1-sigma of the principal point (column, row), px."""
        column, row = np.sqrt(np.diag(self.fit.covariance)[1:3]).tolist()
        return column, row

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
    image: ImageLike,
    *,
    dark: ImageLike | None = None,
    settings: StarSettings = StarSettings(),  # noqa: B008
) -> Stars:
    """Stars of a raw image with centroids and their covariances, brightest first.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, or path
        Raw counts, integers from 0 to 65535 or floating, at least 32 px a side; colours become grey, and what
        is no number or masked has no weight; or a PNG, TIFF, FITS, JPEG, BMP or .npy file.
    dark : (H, W) array, or path, optional
        Dark frame of the same camera and exposure time.
    settings : StarSettings
        Detection threshold, PSF; `saturation_dn` for a floating image, whose saturation is not known.

    Returns
    -------
    Stars
        `len(stars)`, arrays `xy_px` (N, 2), `cov_px` (N, 2, 2), `flux_dn` (N,), ...; `table()`, `plot()`.

    Raises
    ------
    ValueError
        If the array has another shape or type, is smaller than 32 px, has no pixel that is a number, or the
        dark frame has another size.
    RawDataError
        If a file cannot be read.

    Examples
    --------
    >>> import boresight as bs
    >>> stars = bs.find_stars(bs.example("mini") / "exposures/e0001.png")
    >>> len(stars) > 50, stars.xy_px.shape == (len(stars), 2)
    (True, True)
    """
    chosen, read = accepted.instance_of(settings, StarSettings, "settings"), _pixels(image, "image")
    frame = None if dark is None else _pixels(dark, "dark").pixels
    if frame is not None and frame.shape != read.pixels.shape:
        raise accepted.wrong("dark", f"shape {frame.shape}", f"{read.pixels.shape}, that of the image")
    if read.floating and chosen.saturation_dn is None:
        chosen = replace(chosen, saturation_dn=np.inf)
    return Stars(
        star_list=stars_of_image(read.pixels, chosen, frame, read.hidden),
        size_px=(read.pixels.shape[1], read.pixels.shape[0]),
        masked=0 if read.hidden is None else int(np.count_nonzero(read.hidden)),
        pixels=read.pixels,
    )


def identify(
    image: ImageLike | Stars | pd.DataFrame,
    *,
    size: tuple[int, int] | None = None,
    camera: StarCamera | None = None,
    fov_deg: float | None = None,
    time: TimeLike | None = None,
    site: SiteLike | None = None,
    settings: StarSettings = StarSettings(),  # noqa: B008
) -> StarSolution | NotIdentified:
    """Where an image of the sky points, and which stars it shows; no prior attitude is needed.

    Parameters
    ----------
    image : (H, W) or (H, W, 3) array, path, Stars, (N, 2) array, or DataFrame
        A raw image; or what `find_stars` found in it; or centroids, as `Stars.of_centroids` takes them.
    size : (width, height), optional
        Of centroids without a camera: the size of their image, px.
    camera : StarCamera, optional
        The calibrated camera. Without it the lens is fitted to this image.
    fov_deg : float, optional
        Width of the field of view, deg, good to 10 %; to be stated of fisheyes. Without camera and field of
        view, 5 to 60 deg are searched.
    time : str, datetime, datetime64 or astropy Time, optional
        Middle of the exposure, UTC, such as "2026-03-01T12:00:00": the Earth's aberration is then removed.
        A datetime without time zone is UTC.
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
        If camera and fov_deg are both given, or a site without time, fov_deg is not between 0.5 and 175, or
        an argument is not as described.
    RawDataError
        If a file cannot be read or the time is not covered by the Earth-orientation tables.

    Examples
    --------
    >>> import boresight as bs
    >>> solution = bs.identify(bs.example("mini") / "exposures/e0001.png", fov_deg=20)
    >>> if solution:
    ...     print(len(solution.hip) > 50, solution.sigma_arcsec[0] < 5)
    True True
    """
    known, width_deg = _known_of(camera, fov_deg)
    chosen = accepted.instance_of(settings, StarSettings, "settings")
    if site is not None and time is None:
        raise ValueError("site needs time: where a place on the Earth points depends on the time")
    place = None if site is None else accepted.site_of(site)
    observer = None if time is None else observer_at(accepted.utc_of(time, "time"), place)
    if (stars := stars_given(image, size, known)) is None:
        stars = find_stars(image, settings=chosen)  # type: ignore[arg-type]
    if known is not None and (known.width_px, known.height_px) != stars.size_px:
        raise accepted.wrong(
            "camera", f"{known.width_px} x {known.height_px} px", f"{stars.size_px}, as the image has"
        )
    field = solve_list(
        stars.star_list,
        stars.size_px,
        sky_index(known, width_deg, chosen),
        with_unknown_time(chosen),
        camera=known,
        fov_x_rad=None if width_deg is None else float(np.radians(width_deg)),
        observer=observer,
    )
    if isinstance(field, NotIdentified):
        return field
    if isinstance(image, str | os.PathLike):
        field = with_error_of_focus(field, accepted.path_of(image, "image"))
    return StarSolution(field=field, stars=stars, observer=observer)


def stars_given(
    given: ImageLike | Stars | pd.DataFrame, size: tuple[int, int] | None, camera: StarCamera | None
) -> Stars | None:
    """Stars, or centroids in an image of `size` or of a camera, as `Stars`; None for an image."""
    if are_centroids(given):
        if size is None and camera is not None:
            size = camera.width_px, camera.height_px
        if size is None:
            raise accepted.wrong("size", size, "(width, height) of the image, or a camera, with centroids")
        return Stars.of_centroids(given, size_px=size)
    if size is not None:
        raise accepted.wrong("size", size, "no size: an image, and Stars, have their own")
    return given if isinstance(given, Stars) else None


def _known_of(camera: StarCamera | None, fov_deg: float | None) -> tuple[StarCamera | None, float | None]:
    """A camera or a field of view, as far as they are stated, checked."""
    if camera is not None and fov_deg is not None:
        raise ValueError("camera and fov_deg exclude one another: the camera knows its field of view")
    width = None if fov_deg is None else accepted.number_of(fov_deg, "fov_deg")
    if width is not None and not NARROWEST_DEG < width < WIDEST_DEG:
        raise ValueError(f"fov_deg must be between {NARROWEST_DEG:g} and {WIDEST_DEG:g} deg, got {width:g}")
    return None if camera is None else accepted.instance_of(camera, StarCamera, "camera"), width


def calibrate_star_camera(
    images: Iterable[ImageLike | Stars] | ImageLike | Stars,
    *,
    camera: StarCamera | None = None,
    fov_deg: float | None = None,
    times: Iterable[TimeLike] | TimeLike | None = None,
    site: SiteLike | None = None,
    settings: StarSettings = StarSettings(),  # noqa: B008
    progress: Progress = no_progress,
) -> CameraSolution | NotIdentified:
    """Focal length, principal point and distortion of a star camera from images of the sky.

    Parameters
    ----------
    images : iterable of (H, W) arrays, paths, or Stars; or one of them
        Images of one camera, of different fields or at different roll angles; 20 identified stars are needed,
        ten images are good.
    camera : StarCamera, optional
        A first, nominal camera, focal length good to 10 %; its pixel pitch is kept.
    fov_deg : float, optional
        Width of the field of view, deg, good to 10 %. Without either, the first image that can be identified
        without them gives it, and pixels are taken to be 5 µm wide.
    times : iterable of str, datetime, datetime64 or astropy Time, optional
        Middle of each exposure, UTC. Without them the Earth's aberration changes the focal length, by up to
        1e-4 of it.
    site : (latitude deg, longitude deg, height m), optional
        Of a camera on the ground, with `times`: refraction is removed, too.
    settings : StarSettings
        Limits of detection and identification.
    progress : callable, optional
        Called with the stage, the tasks done and all tasks; default: a bar in a notebook, else nothing.

    Returns
    -------
    CameraSolution or NotIdentified
        `NotIdentified` is false and has a `reason`.

    Raises
    ------
    ValueError
        If there are no images, they differ in size, there is not one time for each, or an argument is not as
        described.
    RawDataError
        If a file cannot be read.

    Examples
    --------
    >>> import boresight as bs
    >>> folder = bs.example("mini") / "exposures"
    >>> found = bs.calibrate_star_camera([folder / f"e{n:04d}.png" for n in (1, 9, 17, 25)], fov_deg=20)
    >>> found.rms_px < 0.2
    True
    """
    camera, fov_deg = _known_of(camera, fov_deg)
    chosen, told = accepted.instance_of(settings, StarSettings, "settings"), accepted.progress_of(progress)
    place = None if site is None else accepted.site_of(site)
    if site is not None and times is None:
        raise ValueError("site needs times: where a place on the Earth points depends on the time")
    given = (
        [images] if isinstance(images, Stars) else accepted.listed(images, "images", "arrays, paths or Stars")
    )
    if not given:
        raise accepted.wrong("images", "none", "at least one")
    if isinstance(times, str | datetime.datetime | np.datetime64) or getattr(times, "isscalar", False):
        times = [times]  # type: ignore[list-item]
    utc = (
        None
        if times is None
        else [accepted.utc_of(time, "times") for time in accepted.listed(times, "times", "times")]
    )
    if utc is not None and len(utc) != len(given):
        raise ValueError(f"{len(utc)} times given for {len(given)} images")
    names = [
        str(image) if isinstance(image, str | os.PathLike) else f"image {n}" for n, image in enumerate(given)
    ]
    every = [
        image if isinstance(image, Stars) else find_stars(image, settings=chosen)
        for image in accepted.counted(given, "star images", told)
    ]
    if len(sizes := {stars.size_px for stars in every}) != 1:
        raise ValueError(f"images must be of one size, got {sorted(sizes)}")
    if camera is not None and (camera.width_px, camera.height_px) != every[0].size_px:
        raise accepted.wrong(
            "camera", f"{camera.width_px} x {camera.height_px} px", f"{every[0].size_px}, the images'"
        )
    if camera is None:
        for stars in every if fov_deg is None else ():
            if first := identify(stars, settings=chosen):
                fov_deg = first.fov_deg
                break
        if fov_deg is None:
            return NotIdentified(f"none of {len(every)} images can be identified without fov_deg")
        camera = nominal_camera(every[0].size_px, float(np.radians(fov_deg)))
    index = sky_index(None, float(np.degrees(camera.fov_x_rad)), chosen)
    observers = [None] * len(every) if utc is None else [observer_at(time, place) for time in utc]
    frames = [SkyFrame(*frame) for frame in zip(names, (stars.star_list for stars in every), observers)]
    fit = calibrate_camera(frames, camera, index, with_unknown_time(chosen))
    return fit if isinstance(fit, NotIdentified) else CameraSolution(fit=fit)


def image_pixels(image: ImageLike, name: str) -> NDArray[Any]:
    """Grey values (H, W) of a file or an array, as `find_stars` takes them; `name` is the argument's."""
    return _pixels(image, name).pixels


def _pixels(image: object, name: str) -> _Pixels:
    """An image of a file or an array as grey values."""
    if isinstance(image, str | os.PathLike):
        path = accepted.path_of(image, name)
        pixels = read_star_image(path, str(path))
        return _Pixels(_as_counts(_large(pixels, name)), None, pixels.dtype.kind == "f")
    try:
        planes = np.asarray(image)
    except Exception:  # of ragged lists and foreign classes
        raise accepted.wrong(name, image, "an array of shape (H, W) or (H, W, 3), or a path") from None
    hidden = np.ma.getmaskarray(image) if np.ma.is_masked(image) else None
    if hidden is not None and hidden.all():
        raise accepted.wrong(name, "an array of which all is masked", "pixels that are not masked")
    if planes.ndim not in (2, 3) or planes.dtype.kind not in "uif" or not planes.size:
        raise accepted.wrong(name, planes, "numbers of shape (H, W) or (H, W, 3), or a path")
    whole = planes.dtype.kind in "ui" and planes.dtype not in (np.uint8, np.uint16)
    if whole and not 0 <= planes.min() <= planes.max() <= MOST_COUNTS:
        found = f"integers from {planes.min()} to {planes.max()}"
        raise accepted.wrong(name, found, f"counts from 0 to {MOST_COUNTS}, or floating point")
    floating = planes.dtype.kind == "f"
    no_number = ~np.isfinite(planes) if floating else None
    if hidden is not None:  # of a masked array: as what is no number
        no_number = hidden if no_number is None else no_number | hidden
        planes = np.where(hidden, np.asarray(np.median(planes[~hidden])).astype(planes.dtype), planes)
    try:
        grey = _large(grey_image(planes, name), name)
    except RawDataError as error:
        raise accepted.of_argument(name, error) from error
    if no_number is not None and planes.ndim == 3:
        no_number = no_number.any(axis=0 if planes.shape[1:] == grey.shape else 2)
    hidden = no_number if no_number is not None and no_number.any() else None
    return _Pixels(_as_counts(grey), hidden, floating)


def _as_counts(grey: NDArray[Any]) -> NDArray[Any]:
    """Whole floating numbers as 8 or 16 bits, as integers are: one image has one list of stars."""
    whole = grey.dtype.kind == "f" and 0 <= grey.min() <= grey.max() <= MOST_COUNTS and not (grey % 1).any()
    return grey.astype(np.uint8 if grey.max() <= 255 else np.uint16) if whole else grey


def _large(pixels: NDArray[np.generic], name: str) -> NDArray[np.generic]:
    if min(pixels.shape) < SMALLEST_PX:
        raise accepted.wrong(name, f"shape {pixels.shape}", f"at least {SMALLEST_PX} px a side")
    return pixels


def _sky_axes(ax: Axes | None, size_px: tuple[int, int], image: ImageLike | None) -> Axes:
    """Axes over a detector, row 0 on top, with the image in grey if there is one."""
    ax = axes_or_new(ax)
    if image is not None:
        grey = image_pixels(image, "image").astype(float)
        if grey.shape != size_px[::-1]:
            raise accepted.wrong(
                "image", f"shape {grey.shape}", f"the image of these stars, shape {size_px[::-1]}"
            )
        low, high = np.nanpercentile(grey, (1.0, 99.7))
        ax.imshow(grey, cmap="gray", vmin=low, vmax=high)
    ax.set(xlim=(-0.5, size_px[0] - 0.5), ylim=(size_px[1] - 0.5, -0.5), aspect="equal")
    ax.set(xlabel="column, px", ylabel="row, px")
    return ax


def _world() -> Any:
    """The module of world coordinates."""
    from boresight.features.sky_images import wcs_files  # with astropy 0.4 s to load

    return wcs_files
