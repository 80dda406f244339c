"""Unknowns that several strips share: the camera's distortion, targets' coordinates, the orbit's bias,
the Earth's rotation where it is predicted, alignments of heads.

Each is one named unknown of the whole calibration and does not average over strips. A target's coordinates
are three unknowns in metres, in axes that rotate with the Earth about the pole of GCRS, which agree with ITRS
closely enough for errors of metres; those of a star are its direction in µrad, GCRS axes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import Knot, knots_touched, prior_information, unknown_names
from boresight.calib.heads import head_names
from boresight.calib.interior_parameters import InteriorModel
from boresight.calib.orbit_bias import BIASES, bias_prior
from boresight.calib.predicted_earth import earth_names, prior_of_predictions
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.constants import EARTH_ROTATION_RATE
from boresight.geometry.record import Bools, array, record, scalar

__all__ = [
    "MICRORADIAN",
    "SIGMA_ALIGNMENT_RAD",
    "SeenTargets",
    "SharedUnknowns",
    "coordinate_covariance",
    "coordinate_names",
    "earth_axes",
    "find_shared",
]

Array = NDArray[np.float64]
MICRORADIAN = 1e-6  # rad: unit of stars' directions as unknowns, of a size like metres on the ground
SIGMA_ALIGNMENT_RAD = 0.01  # of alignments between heads: wide, the attitudes themselves give arc-seconds


@record(kw_only=True)
class SeenTargets:
    """The targets of one strip, as far as other strips may share unknowns with them."""

    target_id: NDArray[np.str_] = array("J", "ids of the targets")
    curve: NDArray[np.int64] = array("J", "curve of the residual distortion that each sighting lies on")
    place: Array = array("J", "along that curve, correlation lengths")
    distortion_rad: Array = array("J", "1-sigma of that curve")
    modes_rad: Array = array("J, 3", "change by shift, slope and bend of its CCD")
    unit: NDArray[np.int64] = array("J", "CCD of each sighting, numbered over all cameras")
    cov_coordinates: Array = array("J, 3, 3", "of the coordinates, m²; of stars µrad²")
    is_star: Bools = array("J", "targets that are stars")
    earth: str = scalar("prediction of Earth orientation at the strip's date; empty: measured")


@record
class SharedUnknowns:
    """The unknowns of a calibration beside theta, in the order of the information pairs' rows."""

    knots: tuple[Knot, ...] = scalar("of the camera's distortion: along x, then along y")
    targets: tuple[str, ...] = array("T", "ids of the targets, three unknowns each")
    cov_targets: Array = array("T, 3, 3", "prior covariance of their coordinates, m²; of stars µrad²")
    n_treated_independent: int = scalar("targets in several strips beyond the limit")
    heads: tuple[str, ...] = scalar("heads beside the reference head, three unknowns each", default=())
    biases: tuple[str, ...] = scalar("of `orbit_bias.BIASES`, where ground and sky are seen", default=())
    earth: tuple[str, ...] = scalar("predictions of Earth orientation, three unknowns each", default=())
    interior: InteriorModel | None = scalar("interior orientation of the camera, if unknown", default=None)
    ccds: tuple[int, ...] = scalar("CCDs with a residual distortion of their own, along x and y", default=())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the matrices."""
        interior = self.interior.unknowns if self.interior else ()
        of_camera = unknown_names(self.knots, self.ccds) + interior
        of_ground = coordinate_names(self.targets) + self.biases + earth_names(self.earth)
        return of_camera + of_ground + head_names(self.heads)

    def prior_information(self) -> Array:
        """Inverse prior covariance (n, n), distortion and interior orientation in units of their priors,
        coordinates in metres or µrad, biases in units of the stated errors of a strip, rotations of the
        Earth in units of their 1-sigma, alignments in radians.
        """
        alignments = np.eye(3 * len(self.heads)) / SIGMA_ALIGNMENT_RAD**2
        interior = np.eye(len(self.interior.unknowns) if self.interior else 0)
        camera = prior_information(unknown_names(self.knots, self.ccds))
        parts = [camera, interior, *np.linalg.inv(self.cov_targets)]
        parts += [bias_prior(self.biases), prior_of_predictions(earth_names(self.earth)), alignments]
        parts = [part for part in parts if part.size]
        return np.asarray(block_diag(*parts)) if parts else np.zeros((0, 0))


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
    strips: Sequence[SeenTargets],
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
    covariances = np.array([covariance[name] for name in kept]).reshape(-1, 3, 3)
    mixed = any(s.is_star.any() for s in strips) and any(not s.is_star.all() for s in strips)
    return SharedUnknowns(
        knots=tuple(sorted(knots)),
        targets=kept,
        cov_targets=covariances,
        n_treated_independent=len(often) - len(kept),
        heads=heads,
        biases=BIASES if mixed else (),
        earth=tuple(sorted({strip.earth for strip in strips if strip.earth})),
        interior=interior,
        ccds=tuple(sorted(ccds)),
    )
