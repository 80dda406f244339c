"""A sequence of star images of one calibrated camera: attitude and rate of each frame from the one before."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from boresight.accepted import (
    ImageLike,
    Progress,
    counted,
    floats_of,
    instance_of,
    listed,
    no_progress,
    number_of,
    progress_of,
    wrong,
)
from boresight.display import Result, axes_or_new
from boresight.features.sky_images import tracking
from boresight.features.sky_images.api import Stars, find_stars, identify, image_pixels, stars_given
from boresight.features.sky_images.identify_images import sky_index
from boresight.geometry.constants import ARCSEC
from boresight.geometry.star_camera import StarCamera
from boresight.records.record import Floats, Ints, array, record, scalar
from boresight.star_id.field import ra_dec_roll
from boresight.star_id.finding.star_list import StarList
from boresight.star_id.identification.triangle_index import StarIndex
from boresight.star_id.settings import StarSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["StarTrack", "track"]

TRACKED, FOUND_ANEW, LOST = "tracked", "found anew", "lost"  # states of a frame


@record(kw_only=True)
class StarTrack(Result):
    """Attitudes of a sequence of N frames. Numbers of lost frames are NaN."""

    t_s: Floats = array("N", "middle of each exposure, s, as given")
    state: tuple[str, ...] = array("N", '"tracked", "found anew" (by a search of the whole sky) or "lost"')
    quat_si: Floats = array("N, 4", "attitude, GCRS to star-camera frame s, as quaternion x, y, z, w")
    cov_s: Floats = array("N, 3, 3", "covariance of a small rotation about the axes of s, rad²")
    rate_deg_s: Floats = array("N, 3", "rotation of the camera about the axes of s, deg/s; NaN: unknown")
    focal_px: Floats = array("N", "focal length, px")
    focal_sigma_px: Floats = array("N", "its 1 sigma, px; 0: taken as exact")
    misfit_px: Floats = array(
        "N", "rms displacement of stars from a camera with that focal length, an axis, px; 0: none seen"
    )
    stars: Ints = array("N", "stars that each frame's attitude rests on")
    cpu_ms: Floats = array("N", "processor time of each frame, ms")
    reason: tuple[str, ...] = array("N", "why a frame is lost; else empty")
    camera: StarCamera = scalar("the camera as given")

    def __len__(self) -> int:
        return len(self.t_s)

    def R_si(self, frame: int) -> Rotation:
        """Attitude of a frame, GCRS to s; `ValueError` for a lost one."""
        if self.state[frame] == LOST:
            raise ValueError(f"frame {frame} is lost: {self.reason[frame]}")
        return Rotation.from_quat(self.quat_si[frame])

    def summary(self) -> str:
        """Three lines, as `print` shows them."""
        count = {name: self.state.count(name) for name in (TRACKED, FOUND_ANEW, LOST)}
        known = np.isfinite(self.quat_si[:, 0])
        across = self.camera.middle_axes()[:, :2]
        both = np.einsum("ia,nij,ja->n", across, self.cov_s[known], across)
        median = f"{np.median(np.sqrt(0.5 * both)) / ARCSEC:.2f}" if known.any() else "-"
        last = np.flatnonzero(known)[-1:]
        focal = "".join(f"{self.focal_px[n]:.3f} +- {self.focal_sigma_px[n]:.3f}" for n in last) or "-"
        return (
            f"{len(self)} frames: {count[TRACKED]} tracked, {count[FOUND_ANEW]} found anew,"
            f" {count[LOST]} lost\n"
            f"median error of the direction {median} arcsec (1 sigma an axis); focal length {focal} px\n"
            f"processor time {self.cpu_ms.mean():.1f} ms a frame, {self.cpu_ms.max():.0f} ms at most"
        )

    def table(self) -> pd.DataFrame:
        """One row a frame: time, state, direction and roll with 1-sigma, rates, stars, cpu_ms, reason."""
        places = np.full((len(self), 3), np.nan)
        for n in np.flatnonzero(np.isfinite(self.quat_si[:, 0])):
            places[n] = np.degrees(ra_dec_roll(self.camera, self.R_si(n)))
        axes = self.camera.middle_axes()
        variance = np.einsum("ia,nij,ja->na", axes, self.cov_s, axes)
        columns = {"t_s": self.t_s, "state": self.state}
        columns |= dict(zip(("ra_deg", "dec_deg", "roll_deg"), places.T))
        columns |= {"pointing_sigma_arcsec": np.sqrt(0.5 * variance[:, :2].sum(axis=1)) / ARCSEC}
        columns |= {"roll_sigma_arcsec": np.sqrt(variance[:, 2]) / ARCSEC}
        columns |= dict(zip(("rate_x_deg_s", "rate_y_deg_s", "rate_z_deg_s"), self.rate_deg_s.T))
        columns |= {name: getattr(self, name) for name in ("focal_px", "focal_sigma_px", "misfit_px")}
        return pd.DataFrame(columns | {"stars": self.stars, "cpu_ms": self.cpu_ms, "reason": self.reason})

    def plot(self, ax: Axes | None = None) -> Axes:
        """Rates about the axes of s over time; lost frames as grey lines."""
        ax = axes_or_new(ax)
        for name, rate in zip("xyz", self.rate_deg_s.T):
            ax.plot(self.t_s, rate, ".-", label=f"about {name}")
        for t_s in self.t_s[[state == LOST for state in self.state]]:
            ax.axvline(t_s, color="0.7", linewidth=1.0)
        ax.set(xlabel="time, s", ylabel="rate, deg/s")
        ax.legend(frameon=False)
        return ax


def track(
    frames: Iterable[ImageLike | Stars | pd.DataFrame],
    *,
    camera: StarCamera,
    times_s: ArrayLike | None = None,
    interval_s: float = 0.1,
    exposure_s: float | None = None,
    acceleration_deg_s2: float = 0.5,
    focal_error: float = 1e-3,
    focal_drift: float = 1e-7,
    settings: StarSettings = StarSettings(),  # noqa: B008
    progress: Progress = no_progress,
) -> StarTrack:
    """Attitude and rate of each frame of a sequence, predicted from the frame before.

    While the prediction holds, stars are measured at their predicted places. A frame where they are not there
    is searched as by `identify`: it is "found anew" or "lost". The first two frames are always found anew,
    since the rate is unknown.

    Parameters
    ----------
    frames : iterable of (H, W) arrays, paths, Stars, or centroids as of `Stars.of_centroids`
        Raw images in the order of time, which are read one by one; or lists of stars, each of which is found
        anew.
    camera : StarCamera
        The calibrated camera.
    times_s : (N,) array, optional
        Middle of each exposure, s, increasing. Without it frames are `interval_s` apart.
    interval_s : float
        Time from frame to frame, s.
    exposure_s : float, optional
        Exposure time: the rate then predicts the trails of the stars. State it for rates above a pixel an
        exposure.
    acceleration_deg_s2 : float
        Change of the rate that is to be expected, 1 sigma about each axis, deg/s².
    focal_error : float
        Error of the camera's focal length, relative, 1 sigma: it is refined by the stars, frame by frame. 0:
        it is exact.
    focal_drift : float
        Relative change of the focal length in one second, 1 sigma; of a random walk.
    settings : StarSettings
        Limits of detection and identification.
    progress : callable, optional
        Called with the stage, the tasks done and all tasks; default: a bar in a notebook, else nothing.

    Returns
    -------
    StarTrack
        Aberration is not removed: directions are those of the catalogue.

    Raises
    ------
    ValueError
        If the times are not increasing or not one a frame, or an argument is not as described.
    RawDataError
        If a file cannot be read.

    Examples
    --------
    >>> import boresight as bs
    >>> seen = bs.identify(bs.example("mini") / "exposures/e0001.png", fov_deg=20)
    >>> found = bs.track([bs.example("mini") / "exposures/e0001.png"] * 4, camera=seen.camera)
    >>> found.state
    ('found anew', 'found anew', 'tracked', 'tracked')
    """
    known, chosen = instance_of(camera, StarCamera, "camera"), instance_of(settings, StarSettings, "settings")
    step, told = number_of(interval_s, "interval_s", 0.0), progress_of(progress)
    if not step > 0.0:
        raise wrong("interval_s", interval_s, "a time above 0 s")
    exposure = None if exposure_s is None else number_of(exposure_s, "exposure_s", 0.0)
    push = float(np.radians(number_of(acceleration_deg_s2, "acceleration_deg_s2", 0.0)))
    errors = number_of(focal_error, "focal_error", 0.0), number_of(focal_drift, "focal_drift", 0.0)
    given = listed(frames, "frames", "arrays or paths")
    if not given:
        raise wrong("frames", "none", "at least one")
    at = step * np.arange(len(given)) if times_s is None else floats_of(times_s, "times_s", "(N,)")
    t_s = np.asarray(at, dtype=np.float64)
    if t_s.shape != (len(given),) or not (np.isfinite(t_s).all() and (np.diff(t_s) > 0.0).all()):
        raise wrong("times_s", f"{t_s.shape}", f"{len(given)} increasing times, one a frame")
    tracker = _Tracker(known, sky_index(known, None, chosen), chosen, exposure, push, *errors)
    rows = [tracker.next(image, float(t)) for image, t in zip(counted(given, "star images", told), t_s)]
    state, quat, cov, rate, focal, sigma, misfit, stars, cpu, reason = zip(*rows)
    return StarTrack(
        t_s=t_s,
        state=state,
        quat_si=np.array(quat),
        cov_s=np.array(cov),
        rate_deg_s=np.degrees(rate),
        focal_px=np.array(focal),
        focal_sigma_px=np.array(sigma),
        misfit_px=np.array(misfit),
        stars=np.array(stars),
        cpu_ms=np.array(cpu),
        reason=reason,
        camera=known,
    )


_Row = tuple[str, Floats, Floats, Floats, float, float, float, int, float, str]


@dataclass(slots=True, eq=False)
class _Tracker:
    """What is known after each frame."""

    camera: StarCamera
    index: StarIndex
    settings: StarSettings
    exposure_s: float | None
    push: float  # 1-sigma acceleration about each axis, rad/s²
    focal_error: float
    focal_drift: float
    motion: tracking.CameraMotion | None = None
    seen: StarList | None = None  # of the last frame that was searched as a whole

    def next(self, frame: ImageLike | Stars | pd.DataFrame, t_s: float) -> _Row:
        """The row of the next frame."""
        stars = stars_given(frame, None, self.camera)
        given = image_pixels(frame, "frames") if stars is None else stars  # type: ignore[arg-type]
        size = given.size_px if isinstance(given, Stars) else given.shape[::-1]
        if size != (self.camera.width_px, self.camera.height_px):
            raise wrong("frames", f"{size[0]} x {size[1]} px", "images of the camera's size")
        started_s, fix, now, state, reason = time.process_time(), None, None, TRACKED, ""
        if self.motion is not None:
            now = tracking.predicted_motion(self.motion, t_s, self.push, self.focal_drift)
        if now is not None and self.seen is not None and not isinstance(given, Stars):
            fix = tracking.near_prediction(
                given, now, self.seen, self.camera, self.index, self.settings, exposure_s=self.exposure_s
            )
        if fix is None:
            state, (fix, reason) = FOUND_ANEW, self._anew(given)
        cpu_ms = 1e3 * (time.process_time() - started_s)
        if fix is None:
            unknown = np.full(4, np.nan), np.full((3, 3), np.nan), np.full(3, np.nan)
            return LOST, *unknown, np.nan, np.nan, np.nan, 0, cpu_ms, reason
        first = tracking.motion_of_fix(fix, t_s, self.focal_error)
        self.motion = motion = first if now is None else tracking.with_fix(now, fix)
        rate = motion.rate_s if motion.rate_known else np.full(3, np.nan)
        focal_px = self.camera.focal_m / self.camera.pixel_m * math.exp(motion.log_scale)
        sigma_px = focal_px * math.sqrt(motion.covariance[6, 6])
        attitude = motion.R_si.as_quat(), motion.covariance[:3, :3], rate
        return state, *attitude, focal_px, sigma_px, fix.misfit_px, fix.stars, cpu_ms, ""

    def _anew(self, frame: NDArray[Any] | Stars) -> tuple[tracking.StarFix | None, str]:
        """The attitude of a frame of which nothing is known, or why there is none."""
        stars = frame if isinstance(frame, Stars) else find_stars(frame, settings=self.settings)
        found = identify(stars, camera=self.camera, settings=self.settings)
        if not found:
            return None, found.reason
        if found.mirrored:
            return None, "a mirror image: reverse the columns of all frames"
        psf = stars.star_list.psf
        trailed = psf.shape is not None or psf.smear_px != (0.0, 0.0)
        if self.seen is None or self.exposure_s is None or not trailed:
            self.seen = stars.star_list  # else the rate gives the trail, and the PSF is that of sharp stars
        return tracking.StarFix(found.R_si, found.cov_s, len(found.hip), 0.0, found.misfit_px), ""
