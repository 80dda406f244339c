"""Parameters of a line camera's interior orientation, their priors, and the gauge that parts them.

Parameters change the camera of the dump: focal length (relative); of each CCD a shift along and across the
detector (px), a rotation (rad), a scale (relative), a smooth curve of the distortion along and across (px at
knots, cubic spline between them), and the delay of its rows (s; the stagger of its TDI stages). With x the
assumed image point, a the direction of the detector, n that across it, A the distance from the principal
sample,

    dx = a (shift + A scale + curve) + n (shift' - A rotation + curve'),

and the look direction is [-x, -y, f], normalised. What these parameters have in common with one another, or
with the installation matrix, no data tell apart: changes D of them leave all look directions as they are, but
for a rotation of the whole. It is zero by constraint, G p = 0 (the gauge). A prior p ~ N(0, L Lᵀ) is moved
into the gauge by the S-transformation (Baarda 1973, S-transformations and criterion matrices),

    S = I - D (G D)⁻¹ G,    S L Lᵀ Sᵀ = B Bᵀ,    p = B z,

which keeps the prior of every look direction; the z are independent with variance one.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.linalg import block_diag

from boresight.calib.error_table import SharedError
from boresight.calib.strips import PreparedStrip
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.records.record import Floats, Ints, array, check_numbers, record, scalar

__all__ = ["Gauge", "InteriorModel", "InteriorPriors"]

NODES = 49  # samples of a CCD over which means are taken
RATE_RAD_S = 0.01  # of a scan: makes delays of rows comparable with looks
# Parameters of each CCD: shift along and across the detector (px), rotation (rad), scale (relative).
OF_CCD = ("shift_along", "shift_across", "rotation", "scale")


@record(by_value=True)
class InteriorPriors:
    """Prior 1-sigma of the parameters. Zero: not estimated."""

    focal: float = 3e-4  # relative: launch, vacuum and temperature; this and the next four above zero
    shift_px: float = 5.0  # each CCD along and across
    rotation_rad: float = 2e-4  # each CCD
    scale: float = 1e-4  # each CCD, relative
    curve_px: float = 3.0  # distortion that the laboratory's table leaves
    curve_length_px: float = 5000.0  # over which it changes in the field; knots lie a quarter apart
    stagger_s: float = 0.0  # delay of a CCD's rows against their time

    def __post_init__(self) -> None:
        check_numbers(self, zero=("stagger_s",))


@record
class Gauge:
    """What is zero by constraint, and why."""

    name: str = scalar("what is zero")
    reason: str = scalar("what it cannot be told from")


@record(kw_only=True)
class InteriorModel:
    """Parameters about an assumed camera, with priors and gauge."""

    camera: LineCamera = scalar("assumed camera")
    names: tuple[str, ...] = array("P", "parameters: focal, shift_along/0, ..., curve_across/0/2, ...")
    knots: tuple[Floats, ...] = scalar("samples of the curves' knots, CCD after CCD")
    basis: Floats = array("P, N", "p = basis z with independent z of variance one")
    gauges: tuple[Gauge, ...] = scalar("what is zero by constraint")

    @classmethod
    def of(cls, camera: LineCamera, priors: InteriorPriors, *, stagger: bool = True) -> InteriorModel:
        """The parameters that `priors` leave free. `stagger` False: strips of one rate only, which do not
        tell a delay of the rows from a shift across the detector.
        """
        spacing = 0.25 * priors.curve_length_px
        counts = [max(4, int(np.ceil((ccd.n_px - 1) / spacing)) + 1) for ccd in camera.ccds]
        knots = tuple(_evenly(ccd, n) for ccd, n in zip(camera.ccds, counts))
        stagger = stagger and priors.stagger_s > 0.0
        names, root = _priors(priors, camera, knots, stagger)
        gauges = (*GAUGES, STAGGER_COMMON if stagger else STAGGER)
        bare = cls(camera=camera, names=names, knots=knots, basis=np.eye(len(names)), gauges=gauges)
        rows = _constraints(bare, stagger)
        same = _unseen_changes(bare, root, len(rows))
        moved = root - same @ np.linalg.solve(rows @ same, rows @ root)
        left, size, _ = np.linalg.svd(moved)
        n = len(names) - len(rows)
        return replace(bare, basis=left[:, :n] * size[:n])

    @property
    def row(self) -> SharedError:
        """The z as a row of the table of errors: they move looks, and delay the rows of a CCD."""

        def delays(strip: PreparedStrip) -> Floats:
            return strip.late_s[:, :, None] * (self.delay_change(strip.ground.ccd) @ self.basis)[:, None, :]

        def looks(strip: PreparedStrip) -> Floats:
            return -self.look_change(strip.ground.ccd, strip.ground.xy_px[:, 0]) @ self.basis

        return SharedError(tuple(f"interior/{n}" for n in range(self.basis.shape[1])), delays, looks)

    def look_change(self, ccd: Ints, sample: Floats) -> Floats:
        """Change (J, 3, P) of the look directions of samples (J,), frame c, by each parameter."""
        change = np.zeros((len(ccd), 3, len(self.names)))
        for c in np.unique(ccd).tolist():
            rows = ccd == c
            change[rows] = self._of_ccd(c, sample[rows])
        return change

    def delay_change(self, ccd: Ints) -> Floats:
        """Change (J, P) of the instants of the rows, s, by each parameter."""
        change = np.zeros((len(ccd), len(self.names)))
        for n, name in enumerate(self.names):
            if name.startswith("stagger/"):
                change[:, n] = ccd == int(name.removeprefix("stagger/"))
        return change

    def corrected(self, values: Floats) -> LineCamera:
        """The camera changed by parameters (P,); delays of rows are not part of it."""
        value = dict(zip(self.names, values.tolist()))
        ccds = tuple(_corrected(c, ccd, self.knots[c], value) for c, ccd in enumerate(self.camera.ccds))
        return replace(self.camera, focal_m=self.camera.focal_m * (1.0 + value["focal"]), ccds=ccds)

    def _of_ccd(self, c: int, sample: Floats) -> Floats:
        ccd, f = self.camera.ccds[c], self.camera.focal_m
        xy, pitch = ccd.focal_plane(sample), ccd.pixel_m
        a, n = ccd.axis, ccd.normal
        along = (xy - ccd.focal_plane(np.array([ccd.principal_sample]))) @ a
        curve = CubicSpline(self.knots[c], np.eye(len(self.knots[c])))(sample) * pitch  # (J, K)
        dv = np.zeros((len(sample), 3, len(self.names)))
        place = {name: k for k, name in enumerate(self.names)}
        dv[:, 2, place["focal"]] = f

        def moves(name: str, size: Floats | float, direction: Floats) -> None:
            dv[:, :2, place[name]] = -np.multiply.outer(np.broadcast_to(size, len(sample)), direction)

        moves(f"shift_along/{c}", pitch, a)
        moves(f"shift_across/{c}", pitch, n)
        moves(f"rotation/{c}", -along, n)
        moves(f"scale/{c}", along, a)
        for k in range(curve.shape[1]):
            moves(f"curve_along/{c}/{k}", curve[:, k], a)
            moves(f"curve_across/{c}/{k}", curve[:, k], n)
        v = np.column_stack([-xy, np.full(len(xy), f)])
        length = np.linalg.norm(v, axis=1)
        u = v / length[:, None]
        across = dv - u[:, :, None] * np.einsum("ja,jap->jp", u, dv)[:, None]
        return np.asarray(across / length[:, None, None])


def _priors(
    priors: InteriorPriors, camera: LineCamera, knots: tuple[Floats, ...], stagger: bool
) -> tuple[tuple[str, ...], Floats]:
    """Names (P,) of all parameters, and a root (P, P) of their prior covariance. The distortion is that of
    one lens: its curves are correlated from CCD to CCD by their distance in the field.
    """
    names, parts = ["focal"], [np.array([[priors.focal]])]
    for c in range(camera.n_ccds):
        names += [f"{one}/{c}" for one in (*OF_CCD, "stagger")[: 4 + stagger]]
        sigmas = (priors.shift_px, priors.shift_px, priors.rotation_rad, priors.scale, priors.stagger_s)
        parts.append(np.diag(sigmas[: 4 + stagger]))
    places = [ccd.focal_plane(own)[:, 1] / ccd.pixel_m for ccd, own in zip(camera.ccds, knots)]
    place = np.concatenate(places)
    apart = np.sqrt(5.0) * np.abs(place[:, None] - place) / priors.curve_length_px
    matern = (1.0 + apart + apart**2 / 3.0) * np.exp(-apart) + 1e-9 * np.eye(len(place))  # Matérn 5/2
    for axis in ("along", "across"):
        names += [f"curve_{axis}/{c}/{k}" for c, own in enumerate(knots) for k in range(len(own))]
        parts.append(priors.curve_px * np.linalg.cholesky(matern))
    return tuple(names), np.asarray(block_diag(*parts))


def _constraints(model: InteriorModel, stagger: bool) -> Floats:
    """Constraints (G, P), in the order of the gauges."""
    camera, names = model.camera, model.names
    rigid, of_ccds, place = np.zeros((3, len(names))), [], {name: n for n, name in enumerate(names)}
    for c, ccd in enumerate(camera.ccds):
        samples = _evenly(ccd, NODES)
        u = camera.directions_from_pixels(c, samples)
        change = model.look_change(np.full(NODES, c), samples)
        # A small rotation about axis k moves u by e_k x u; its mean over all samples is zero.
        for k, e in enumerate(np.eye(3)):
            rigid[k] += ccd.n_px * np.einsum("ja,jap->p", np.cross(e, u), change) / NODES
        spline = CubicSpline(model.knots[c], np.eye(len(model.knots[c])))(samples)
        for axis in ("along", "across"):
            columns = [place[f"curve_{axis}/{c}/{k}"] for k in range(len(model.knots[c]))]
            for moment in (np.ones(NODES), np.linspace(-1.0, 1.0, NODES)):
                row = np.zeros(len(names))
                row[columns] = moment @ spline
                of_ccds.append(row)
    rows = [*rigid, *of_ccds, _sum(model, "scale")]
    return np.array([*rows, _sum(model, "stagger")] if stagger else rows)


def _unseen_changes(model: InteriorModel, root: Floats, n: int) -> Floats:
    """The n changes (P, n) of the parameters that move the look directions least, a rotation of all of them
    aside; `root` (P, P) of the prior makes the parameters comparable.
    """
    u, change = [], []
    for c, ccd in enumerate(model.camera.ccds):
        samples = _evenly(ccd, NODES)
        u.append(model.camera.directions_from_pixels(c, samples))
        change.append(model.look_change(np.full(NODES, c), samples))
    rotations = np.swapaxes(np.cross(np.eye(3), np.concatenate(u)[:, None]), 1, 2).reshape(-1, 3)
    looks = np.concatenate(change).reshape(-1, len(model.names)) @ root
    looks = looks - rotations @ np.linalg.lstsq(rotations, looks)[0]
    delays = model.delay_change(np.arange(model.camera.n_ccds)) @ root
    delays = RATE_RAD_S * (delays - delays.mean(axis=0))
    return np.asarray(root @ np.linalg.svd(np.concatenate([looks, delays]))[2][-n:].T)


def _evenly(ccd: Ccd, n: int) -> Floats:
    """n samples from end to end of a CCD."""
    return np.asarray(np.linspace(0.0, ccd.n_px - 1.0, n), dtype=np.float64)


def _sum(model: InteriorModel, kind: str) -> Floats:
    """Row (P,) whose product with the parameters is the sum of one kind over all samples."""
    row = np.zeros(len(model.names))
    for c, ccd in enumerate(model.camera.ccds):
        row[model.names.index(f"{kind}/{c}")] = ccd.n_px
    return row


# Combinations of interior parameters that no observation tells from another unknown: what is fixed at its
# stated value, and the unknown that takes its place.
GAUGES = (
    Gauge("principal point, in flight direction", "rotation about Y of the installation matrix"),
    Gauge("principal point, along the detectors", "rotation about X of the installation matrix"),
    Gauge("rotation common to all CCDs", "rotation about Z of the installation matrix"),
    Gauge("scale common to all CCDs", "focal length"),
    Gauge("mean and slope of each curve", "shift, rotation and scale of its CCD"),
)
# The delays of rows: where they are estimated only their mean is fixed, else all are.
STAGGER_COMMON = Gauge("delay of the rows common to all CCDs", "offset of the row clock")
STAGGER = Gauge("delay of each CCD's rows", "its shift across the detector, unless strips differ in rate")


def _corrected(c: int, ccd: Ccd, knots: Floats, value: dict[str, float]) -> Ccd:
    """One CCD changed by the parameters; its distortion table is sampled at its own entries and the knots."""
    along, across = (
        CubicSpline(knots, [value[f"curve_{axis}/{c}/{k}"] for k in range(len(knots))])
        for axis in ("along", "across")
    )
    old = np.asarray(ccd.distortion_samples, dtype=float)
    far = np.abs(old[:, None] - knots).min(axis=1) > 0.1 * (knots[1] - knots[0])
    samples = np.sort(np.concatenate([knots, old[far]]))
    # Offsets are real minus ideal: a point that lies further along has a smaller offset.
    shift = ccd.bare.focal_plane(samples) - ccd.focal_plane(samples)
    a, n = ccd.axis, ccd.normal
    pitch, scale, turn = ccd.pixel_m, value[f"scale/{c}"], value[f"rotation/{c}"]
    move = pitch * (value[f"shift_along/{c}"] * a + value[f"shift_across/{c}"] * n)
    principal = ccd.axis_point[1] + move[1]
    return replace(
        ccd,
        x_offset_m=ccd.x_offset_m + move[0],
        rotation_rad=ccd.rotation_rad + turn,
        pixel_m=pitch * (1.0 + scale),
        y_first_m=principal - ccd.principal_sample * pitch * (1.0 + scale),
        distortion_samples=samples,
        distortion_offsets_m=(shift @ a) * (1.0 + scale) - pitch * along(samples),
        across_offsets_m=shift @ n - pitch * across(samples),
    )
