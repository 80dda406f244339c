"""Which change of the star camera explains the residuals of its stars, where these are too large."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from boresight.geometry.record import Floats, record, scalar
from boresight.geometry.sightings import StarSightings
from boresight.geometry.star_camera import StarCamera

__all__ = ["Explanation", "explanations"]

MOST_EXPOSURES = 40  # whose stars are held against other cameras
FEWEST_STARS = 3  # of an exposure: with fewer its attitude takes up every residual
FARTHEST_PX = 20.0  # a star farther from its place is another one


@record(kw_only=True)
class Explanation:
    """A part of the camera model, and how much of the misfit a change of it removes."""

    part: str = scalar("principal point, focal length or radial distortion")
    change: str = scalar("the best change, with its size and unit")
    sizes: tuple[float, ...] = scalar("the same: px, parts of the focal length, 1/mm²")
    share: float = scalar("of the excess of chi-square over its degrees of freedom that the change removes")
    gain: float = scalar("chi-square that it removes")
    dof: int = scalar("degrees of freedom of the stars' residuals")


@record(kw_only=True)
class _Part:
    """One part of the model: cameras with a small step of each of its parameters."""

    name: str = scalar("of the part")
    steps: tuple[tuple[StarCamera, float], ...] = scalar("changed camera, size of its step")
    words: Callable[[Sequence[float]], str] = scalar("the change in words")


def explanations(
    camera: StarCamera, exposures: Sequence[StarSightings], R_si: Floats
) -> tuple[Explanation, ...]:
    """What each part of `camera` would explain of the stars' residuals, the best one first.

    `exposures` (K) are identified stars and `R_si` (K, 3, 3) their attitudes. In each exposure, residuals and
    the effect of each step are freed of what a rotation of the camera absorbs; the steps are then fitted to
    the residuals of all exposures by least squares, one part at a time.
    """
    parts, misfit = _parts(camera), []
    changed: list[list[Floats]] = [[] for _ in parts]
    chosen = np.linspace(0, len(exposures) - 1, min(len(exposures), MOST_EXPOSURES)).astype(int)
    for k in np.unique(chosen).tolist():
        columns = _free_columns(camera, exposures[k], R_si[k], parts)
        if columns is None:
            continue
        misfit.append(columns[0])
        for into, column in zip(changed, columns[1]):
            into.append(column)
    if not misfit:
        return ()
    y = np.concatenate(misfit)
    dof = len(y) - 3 * len(misfit)
    excess = max(float(y @ y) - dof, 1e-9)
    found = []
    for part, pieces in zip(parts, changed):
        A = np.concatenate(pieces)
        x = np.linalg.lstsq(A, y, rcond=None)[0]
        gain = float(y @ y - np.sum((y - A @ x) ** 2))
        sizes = [value * step for value, (_, step) in zip(x.tolist(), part.steps)]
        found.append(
            Explanation(
                part=part.name,
                change=part.words(sizes),
                sizes=tuple(sizes),
                share=gain / excess,
                gain=gain,
                dof=dof,
            )
        )
    return tuple(sorted(found, key=lambda one: -one.gain))


def _parts(camera: StarCamera) -> tuple[_Part, ...]:
    x, y = camera.principal_px
    return (
        _Part(
            name="principal point",
            steps=(
                (replace(camera, principal_px=(x + 1.0, y)), 1.0),
                (replace(camera, principal_px=(x, y + 1.0)), 1.0),
            ),
            words=lambda s: f"moved by ({s[0]:+.1f}, {s[1]:+.1f}) px",
        ),
        _Part(
            name="focal length",
            steps=((replace(camera, focal_m=camera.focal_m * 1.001), 1e-3),),
            words=lambda s: f"{abs(100 * s[0]):.3f} % {'longer' if s[0] > 0 else 'shorter'}",
        ),
        _Part(
            name="radial distortion",
            steps=((replace(camera, q1=camera.q1 + 1e-6), 1e-6),),
            words=lambda s: f"q1 changed by {s[0]:+.2g} 1/mm²",
        ),
    )


def _free_columns(
    camera: StarCamera, stars: StarSightings, R_si: Floats, parts: Sequence[_Part]
) -> tuple[Floats, Iterator[Floats]] | None:
    """Residuals of one exposure and the effects of each part's steps, in sigmas, free of any rotation."""
    u_s = stars.u_i @ R_si.T
    expected = camera.pixels_from_directions(u_s)
    sigma_px = np.sqrt(0.5 * np.trace(stars.cov_s, axis1=1, axis2=2)) * camera.focal_m / camera.pixel_m
    good = np.isfinite(expected).all(axis=1)
    good &= np.linalg.norm(stars.xy_px - expected, axis=1) < FARTHEST_PX
    if good.sum() < FEWEST_STARS:
        return None
    weight = 1.0 / sigma_px[good, None]

    def weighted(xy: Floats) -> Floats:
        return ((xy - expected)[good] * weight).ravel()

    turns = [camera.pixels_from_directions(u_s + 1e-5 * np.cross(axis, u_s)) for axis in np.eye(3)]
    Q = np.linalg.qr(np.column_stack([weighted(xy) for xy in turns]))[0]

    def free(column: Floats) -> Floats:
        return column - Q @ (Q.T @ column)

    effects = (
        np.column_stack([free(weighted(c.pixels_from_directions(u_s))) for c, _ in part.steps])
        for part in parts
    )
    return free(weighted(stars.xy_px)), effects
