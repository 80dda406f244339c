"""The table of errors that several strips share: each declared once, with its unknowns, prior and columns.

    scope             error                                                    unknowns
    camera            residual distortion, interior orientation                knots, CCDs' modes; parameters
    target            coordinates of one that several strips see               metres; of a star µrad
    satellite         bias of the orbit and of the row clocks                  stated errors of a strip
    date              rotation of the Earth where it is predicted              1-sigma of the prediction
    ground reference  offset of a mosaic or a survey                           1-sigma stated for it
    head              alignment to the reference head                          radians

Each is one named unknown of the whole calibration and does not average over strips. Coordinates are in axes
that rotate with the Earth about the pole of GCRS, which agree with ITRS closely enough for errors of metres;
those of a star are its direction, GCRS axes. Errors of one pass alone are columns of its strips (`strips`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import MODES, OF_CAMERA, Knot, knots_touched, prior_information, unknown_names
from boresight.calib.ground_references import ReferenceField, fields_of
from boresight.calib.heads import head_names, of_heads
from boresight.calib.interior_parameters import InteriorModel
from boresight.calib.orbit_bias import BIASES, bias_prior
from boresight.calib.predicted_earth import earth_names, prior_of_predictions
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.constants import EARTH_ROTATION_RATE
from boresight.geometry.record import Bools, array, record, scalar

if TYPE_CHECKING:
    from boresight.calib.strips import PreparedStrip

__all__ = [
    "MICRORADIAN",
    "SIGMA_ALIGNMENT_RAD",
    "SharedError",
    "SharedUnknowns",
    "coordinate_covariance",
    "coordinate_names",
    "earth_axes",
    "find_shared",
]

Array = NDArray[np.float64]
MICRORADIAN = 1e-6  # rad: unit of stars' directions as unknowns, of a size like metres on the ground
SIGMA_ALIGNMENT_RAD = 0.01  # of alignments between heads: wide, the attitudes themselves give arc-seconds


@dataclass(frozen=True, slots=True, eq=False)
class SharedError:
    """One row of the table: an error that moves the known directions of targets."""

    names: tuple[str, ...]  # of its n unknowns
    prior: Array  # (n, n) information
    columns: Callable[[PreparedStrip], Array]  # change (J, 3, n) of v_s by each


@record(kw_only=True)
class SharedUnknowns:
    """The unknowns of a calibration beside theta, in the order of the information pairs' rows."""

    knots: tuple[Knot, ...] = scalar("of the cameras' distortion: along x, then along y", default=())
    ccds: tuple[int, ...] = scalar("CCDs with a residual distortion of their own, along x and y", default=())
    interior: InteriorModel | None = scalar("interior orientation of the camera, if unknown", default=None)
    errors: tuple[SharedError, ...] = scalar("all others; alignments of heads are the last", default=())
    targets: tuple[str, ...] = array("T", "ids of the targets with unknown coordinates", default=())
    references: tuple[ReferenceField, ...] = scalar("offsets of ground references", default=())
    heads: tuple[str, ...] = scalar("heads beside the reference head, three unknowns each", default=())
    n_treated_independent: int = scalar("targets in several strips beyond the limit", default=0)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the matrices."""
        interior = self.interior.unknowns if self.interior else ()
        of_camera = unknown_names(self.knots, self.ccds) + interior
        return of_camera + tuple(name for error in self.errors for name in error.names)

    def prior_information(self) -> Array:
        """Inverse prior covariance (n, n), each error in its unit."""
        camera = prior_information(unknown_names(self.knots, self.ccds))
        interior = np.eye(len(self.interior.unknowns) if self.interior else 0)
        parts = [part for part in (camera, interior, *(e.prior for e in self.errors)) if part.size]
        return np.asarray(block_diag(*parts)) if parts else np.zeros((0, 0))

    def distortion_of(self, camera: int) -> tuple[NDArray[np.int64], SharedUnknowns]:
        """Numbers (m,) of the knots and CCD modes of one camera, among all of them, and these unknowns."""
        knots = [n for n, (curve, _) in enumerate(self.knots) if curve // OF_CAMERA == camera]
        ccds = [n for n, ccd in enumerate(self.ccds) if ccd // OF_CAMERA == camera]
        modes = [len(self.knots) + k * len(self.ccds) + n for k in range(len(MODES)) for n in ccds]
        own = SharedUnknowns(
            knots=tuple(self.knots[n] for n in knots), ccds=tuple(self.ccds[n] for n in ccds)
        )
        return np.array([*knots, *modes], dtype=np.int64), own

    def columns_s(self, strip: PreparedStrip) -> Array:
        """Change (J, 3, T) of v_s by the unknowns of `errors`."""
        none = np.zeros((len(strip.ccd), 3, 0))
        return np.concatenate([none, *(error.columns(strip) for error in self.errors)], axis=2)


def coordinate_names(targets: Sequence[str]) -> tuple[str, ...]:
    """Names of the unknown coordinates of targets, three each."""
    return tuple(f"target/{name}/{axis}" for name in targets for axis in range(3))


def earth_axes(t_s: Array) -> Array:
    """(J, 3, 3), from the axes in which targets' coordinates are unknown to GCRS at t_s (J,)."""
    return Rotation.from_rotvec(np.outer(EARTH_ROTATION_RATE * t_s, [0.0, 0.0, 1.0])).as_matrix()


def coordinate_covariance(cov_target_i: Array, t_s: Array, u_i: Array, is_star: Bools) -> Array:
    """Covariance (J, 3, 3) of targets' coordinates: on the ground m², axes that rotate with the Earth, from
    GCRS axes; of stars µrad², GCRS axes, from rad².

    A star's covariance has nothing along its direction; its mean there makes it regular and changes no
    direction.
    """
    R_ie = np.where(is_star[:, None, None], np.eye(3), earth_axes(t_s))
    covariance = np.swapaxes(R_ie, 1, 2) @ cov_target_i @ R_ie
    along = u_i[:, :, None] * u_i[:, None, :]
    mean = 0.5 * np.trace(cov_target_i, axis1=1, axis2=2)[:, None, None]
    of_stars = (cov_target_i + mean * along) / MICRORADIAN**2
    return np.asarray(np.where(is_star[:, None, None], of_stars, covariance))


def find_shared(
    strips: Sequence[PreparedStrip],
    settings: CalibrationSettings,
    heads: tuple[str, ...] = (),
    interior: InteriorModel | None = None,
) -> SharedUnknowns:
    """The unknowns that these strips share, the alignments of `heads` among them; biases of orbit and clock
    where there are stars and targets on the ground.

    Of targets in several strips, those seen most often come first.
    """
    knots: set[Knot] = set()
    ccds: set[int] = set()
    for strip in strips if settings.distortion_scope == "camera" else ():
        curved = strip.distortion_rad > 0.0
        knots.update(knots_touched(strip.curve[curved], strip.place[curved]))
        ccds.update(strip.unit[strip.modes_rad.any(axis=1)].tolist())
    count: dict[str, int] = {}
    covariance: dict[str, Array] = {}
    for strip in strips:
        ids, first = np.unique(strip.target_id, return_index=True)
        for name, row in zip(ids.tolist(), first.tolist()):
            count[name] = count.get(name, 0) + 1
            covariance.setdefault(name, strip.cov_coordinates[row])
    often = [name for name, n in count.items() if n > 1 and np.linalg.eigvalsh(covariance[name])[0] > 0.0]
    often.sort(key=lambda name: (-count[name], name))
    kept = tuple(sorted(often[: settings.most_shared_targets]))
    mixed = any(s.is_star.any() for s in strips) and any(not s.is_star.all() for s in strips)
    earth = tuple(sorted({strip.earth for strip in strips if strip.earth}))
    fields = fields_of(strips)
    return SharedUnknowns(
        knots=tuple(sorted(knots)),
        ccds=tuple(sorted(ccds)),
        interior=interior,
        errors=(
            _coordinates(kept, [covariance[name] for name in kept]),
            _biases(BIASES if mixed else ()),
            _earth(earth),
            *(SharedError(one.names, np.eye(len(one.names)), one.columns) for one in fields),
            _alignments(heads),
        ),
        targets=kept,
        references=fields,
        heads=heads,
        n_treated_independent=len(often) - len(kept),
    )


def _coordinates(targets: tuple[str, ...], covariances: Sequence[Array]) -> SharedError:
    number = {name: n for n, name in enumerate(targets)}

    def columns(strip: PreparedStrip) -> Array:
        return _of_each(
            [number.get(name, -1) for name in strip.target_id.tolist()], len(targets), strip.coordinates_s
        )

    prior = block_diag(*np.linalg.inv(covariances)) if targets else np.zeros((0, 0))
    return SharedError(coordinate_names(targets), prior, columns)


def _biases(names: tuple[str, ...]) -> SharedError:
    which = [BIASES.index(name) for name in names]
    return SharedError(names, bias_prior(names), lambda strip: strip.bias_s[:, :, which])


def _earth(predictions: tuple[str, ...]) -> SharedError:
    def columns(strip: PreparedStrip) -> Array:
        n = predictions.index(strip.earth) if strip.earth else -1
        return _of_each([n] * len(strip.ccd), len(predictions), strip.earth_s)

    names = earth_names(predictions)
    return SharedError(names, prior_of_predictions(names), columns)


def _alignments(heads: tuple[str, ...]) -> SharedError:
    """Of the heads whose rows make the attitude at the targets."""

    def columns(strip: PreparedStrip) -> Array:
        return of_heads(strip.heads, strip.by_alignments_s, heads)

    names = head_names(heads)
    return SharedError(names, np.eye(len(names)) / SIGMA_ALIGNMENT_RAD**2, columns)


def _of_each(number: Sequence[int], count: int, change: Array) -> Array:
    """Changes (J, 3, 3) by the three unknowns of an error, `number` of each target, as columns of all `count`
    errors; -1: of none.
    """
    own = np.array(number, dtype=np.int64)[:, None] == np.arange(count)
    return np.asarray((own[:, None, :, None] * change[:, :, None, :]).reshape(len(change), 3, 3 * count))
