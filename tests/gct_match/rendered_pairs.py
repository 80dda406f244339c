"""Pairs of chip and window rendered from a sharper picture, with the true offset and the bound of its
estimation.

The picture (10 cm aerial, or any array) is blurred by a Gaussian camera and sampled every fourth pixel at
known fractions of a pixel; both members of a pair get noise of their own. `condition` is one of

    clean   noise alone
    date    the window's scene with another gamma, an illumination ramp and 15 % of the chip hidden by
    other texture affine  the window rotated by 0.5 degree and scaled by 0.5 %
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

RATIO = 4  # picture pixels to a rendered pixel
MTF_AT_NYQUIST = 0.15
SIGMA_PX = float(
    np.sqrt(-np.log(MTF_AT_NYQUIST) / (2.0 * np.pi**2 * 0.25))
)  # of a Gaussian camera with that MTF
NOISE_DN = 2.0
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


@dataclass(frozen=True)
class Pair:
    template: NDArray  # (n, n)
    window: NDArray  # (n + 2 m, n + 2 m)
    offset_px: NDArray  # (2,) where the template's first pixel lies in the window, at the template's middle
    cov_bound_px: NDArray  # (2, 2) Cramér-Rao bound of the offset for the two noises alone, radiometry known


def load_picture(name: str = "neon_yell_10cm.png") -> NDArray:
    """Grey picture, float32; FileNotFoundError when the shared data is missing."""
    path = DATA / "high_resolution" / name
    colour = cv2.imread(str(path))
    if colour is None:
        raise FileNotFoundError(path)
    return cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY).astype(np.float32)


def _seen(scene: NDArray) -> NDArray:
    """Spline coefficients of `scene` blurred by the camera."""
    blurred = cv2.GaussianBlur(scene, (0, 0), SIGMA_PX * RATIO, borderType=cv2.BORDER_REFLECT)
    return ndimage.spline_filter(blurred, order=3, mode="mirror", output=np.float64)


def _sample(seen: NDArray, centre: NDArray, turn: NDArray, shape_px: int) -> NDArray:
    """Sample (shape_px, shape_px) about `centre` (x, y) of the scene, every RATIO picture pixels."""
    half = (shape_px - 1) / 2.0
    if np.array_equal(turn, np.eye(2)):  # rows and columns one after the other
        for first in (centre - RATIO * half)[::-1]:
            seen = _along(seen, first, shape_px).T
        return seen
    y, x = np.mgrid[0:shape_px, 0:shape_px] - half
    u = np.stack([x, y]) * RATIO
    points = np.tensordot(turn, u, axes=1) + centre[:, None, None]
    return ndimage.map_coordinates(seen, points[::-1], order=3, mode="mirror", prefilter=False)


def _along(coefficients: NDArray, first: float, count: int) -> NDArray:
    """Cubic spline of coefficients (n, m) along the first axis, (count, m), every RATIO from `first` on."""
    whole = int(np.floor(first))
    t, last = first - whole, len(coefficients) - 1
    of_basis = (1.0 - t) ** 3, 4.0 - 3.0 * t * t * (2.0 - t), 1.0 + 3.0 * t * (1.0 + t * (1.0 - t)), t**3
    at = whole - 1 + RATIO * np.arange(count)
    mirrored = [last - np.abs(last - np.abs(at + k)) for k in range(4)]
    return sum(weight / 6.0 * coefficients[rows] for weight, rows in zip(of_basis, mirrored))


@dataclass(frozen=True)
class View:
    """One chip of a picture as the camera sees it, and where in a window it will lie."""

    scene: NDArray  # part of the picture
    centre: NDArray  # (2,) of the chip in the scene, picture pixels
    shift: NDArray  # (2,) of the chip from the window's middle, px
    seen: NDArray  # spline coefficients of the scene, blurred by the camera
    truth: NDArray  # (n, n) the chip without noise
    cov_bound_px: NDArray  # as in `Pair`


def draw_view(picture: NDArray, rng: np.random.Generator, *, size_px: int, margin_px: int) -> View:
    """One random chip of the picture, to lie at up to ± (margin - 4) px of a window's middle."""
    outer = (size_px + 2 * margin_px + 12) * RATIO
    corner = np.array([rng.integers(0, n - outer) for n in picture.shape[::-1]])
    scene = picture[corner[1] : corner[1] + outer, corner[0] : corner[0] + outer]
    centre = np.array([outer / 2.0, outer / 2.0]) + rng.uniform(-2.0, 2.0, 2)
    shift = rng.uniform(-(margin_px - 4), margin_px - 4, 2)
    seen = _seen(scene)
    truth = _sample(seen, centre, np.eye(2), size_px)
    step = 0.4  # picture pixels: the derivative of the picture as the camera sees it, not of its samples
    ahead, behind = (
        [_sample(seen, centre + sign * step * axis, np.eye(2), size_px) for axis in np.eye(2)]
        for sign in (1, -1)
    )
    gx, gy = (RATIO * (a - b) / (2.0 * step) for a, b in zip(ahead, behind))
    fisher = np.array([[np.sum(gx * gx), np.sum(gx * gy)], [np.sum(gx * gy), np.sum(gy * gy)]]) / (
        2.0 * NOISE_DN**2
    )
    return View(scene, centre, shift, seen, truth, np.linalg.inv(fisher))


def make_pair(
    picture: NDArray, rng: np.random.Generator, *, size_px: int, margin_px: int, condition: str
) -> Pair:
    """One random chip of the picture and a window that holds it at up to ± (margin - 4) px of the middle."""
    view = draw_view(picture, rng, size_px=size_px, margin_px=margin_px)
    return pair_of(view, picture, rng, margin_px=margin_px, condition=condition)


def pair_of(
    view: View, picture: NDArray, rng: np.random.Generator, *, margin_px: int, condition: str
) -> Pair:
    """The chip of a view and a window that holds it, each with noise of its own."""
    size_px = len(view.truth)
    turn, other = np.eye(2), view.seen
    if condition == "affine":
        angle, scale = rng.choice([-1, 1]) * np.radians(0.5), 1.0 + rng.choice([-1, 1]) * 0.005
        turn = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    if condition == "tone":
        other = _seen(255.0 * (view.scene / 255.0) ** 2.5)
    if condition == "date":
        other = _seen(255.0 * (view.scene / 255.0) ** np.exp(rng.uniform(-0.5, 0.5)))
    # window pixel v sees scene centre + RATIO (turn (v - middle) - turn shift): the template's middle is
    # at v = middle + shift
    window = _sample(other, view.centre - RATIO * turn @ view.shift, turn, size_px + 2 * margin_px)
    if condition == "date":
        window = _another_date(window, picture, rng, size_px, margin_px, view.shift)
    return Pair(
        (view.truth + rng.normal(0.0, NOISE_DN, view.truth.shape)).astype(np.float32),
        (window + rng.normal(0.0, NOISE_DN, window.shape)).astype(np.float32),
        view.shift + margin_px,
        view.cov_bound_px,
    )


def _another_date(
    window: NDArray, picture: NDArray, rng: np.random.Generator, size_px: int, margin_px: int, shift: NDArray
) -> NDArray:
    n = len(window)
    y, x = (np.mgrid[0:n, 0:n] - n / 2.0) / size_px
    angle = rng.uniform(0.0, 2.0 * np.pi)
    window = window * (1.0 + 0.3 * (np.cos(angle) * x + np.sin(angle) * y))
    aspect = np.exp(rng.uniform(-0.7, 0.7))
    height, width = (round(float(size_px * np.sqrt(0.15) * a)) for a in (aspect, 1.0 / aspect))
    height, width = min(height, size_px), min(width, size_px)
    row = margin_px + int(shift[1]) + rng.integers(0, size_px - height + 1)
    column = margin_px + int(shift[0]) + rng.integers(0, size_px - width + 1)
    outer = (max(height, width) + 12) * RATIO
    corner = [rng.integers(0, m - outer) for m in picture.shape]
    patch = picture[corner[0] : corner[0] + outer, corner[1] : corner[1] + outer]
    cover = _sample(_seen(patch), np.array([outer / 2.0, outer / 2.0]), np.eye(2), max(height, width))[
        :height, :width
    ]
    hidden = window[row : row + height, column : column + width]
    hidden[...] = cover[: hidden.shape[0], : hidden.shape[1]]
    return window
