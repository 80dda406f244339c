"""The table of errors: each declared once, with its unknowns, their prior and their columns.

    scope             error                                                    unknowns
    pass              position, clock of a camera's rows: processes in time    independent parts, 1-sigma each
    camera            residual distortion, interior orientation                knots, CCDs' modes; parameters
    target            coordinates of one that several strips see               metres; of a star µrad
    satellite         bias of the orbit and of the row clocks                  stated errors of a strip
    date              rotation of the Earth where it is predicted              1-sigma of the prediction
    ground reference  offset of a mosaic or a survey                           1-sigma stated for it
    head              alignment to the reference head                          radians
    head              error that comes back with a period: Fourier series      1-sigma each

All but those of a pass are named unknowns of the whole calibration, which do not average over strips.
Coordinates are in axes that rotate with the Earth about the pole of GCRS, which agree with ITRS closely
enough for errors of metres; those of a star are its direction, GCRS axes. The errors at two instants of a
process with a correlation time T have the correlation exp(-|t - t'| / T), whatever pass the instants are of;
without one it is constant over a pass and independent from pass to pass.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from itertools import groupby
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from boresight.calib import distortion
from boresight.calib.ground_references import ReferenceField, fields_of
from boresight.calib.heads import of_heads
from boresight.calib.predicted_earth import earth_names, prior_of_predictions
from boresight.calib.settings import CalibrationSettings
from boresight.geometry.constants import EARTH_ROTATION_RATE
from boresight.geometry.sightings import sigma_of
from boresight.records.record import Bools, Ints, array, inner, record, scalar

if TYPE_CHECKING:
    from boresight.calib.strips import PreparedStrip

__all__ = [
    "BIASES",
    "MICRORADIAN",
    "CommonBias",
    "SharedError",
    "SharedUnknowns",
    "bias_columns",
    "by_kind",
    "common_bias",
    "coordinate_covariance",
    "coordinate_names",
    "earth_axes",
    "find_shared",
    "of_pass",
    "prior_of",
]

Array = NDArray[np.float64]
MICRORADIAN = 1e-6  # rad: unit of stars' directions as unknowns, of a size like metres on the ground
SIGMA_ALIGNMENT_RAD = 0.01  # of alignments between heads: wide, the attitudes themselves give arc-seconds
NO_EFFECT = 1e-9  # of the largest variance of a process: less is rounding
# Names of the biases common to all strips: of the orbit along the track, across it and radially (m), and of
# the row clock (s).
BIASES = ("bias/along", "bias/across", "bias/radial", "bias/clock")
# In units of the stated errors of one strip: wide for the orbit, which the sky has no part in. The scan of
# the sky itself depends on the clock: a wide prior would spoil a matrix that the sky alone determines.
PRIOR_SIGMA = {"bias/along": 10.0, "bias/across": 10.0, "bias/radial": 10.0, "bias/clock": 1.0}
OBSERVABLE = 0.25  # of its prior, the largest 1-sigma with which a bias counts as measured


@record(kw_only=True)
class CommonBias:
    """Biases that all strips share, stated less true, as far as the data determine them.

    Ground strips alone cannot tell them from the installation matrix: their position errors are taken as
    independent from strip to strip. Strips that scan the sky measure the matrix without any position.
    """

    names: tuple[str, ...] = array(
        "N", "along, across (to the right), radial (upwards): m; clock (of the rows): s"
    )
    value: Array = array("N", "stated less true")
    covariance: Array = array("N, N", "of `value`")
    stated: Array = array("N", "1-sigma stated for one strip")
    sigma = inner[Array]("covariance", "1-sigma (N,) of `value`", of=sigma_of)

    def texts(self) -> list[str]:
        """Each bias with its 1-sigma as text, the clock in milliseconds."""
        unit = [("ms", 1e3) if name == "clock" else ("m", 1.0) for name in self.names]
        rows = zip(self.names, self.value, self.sigma, unit)
        return [f"{name} {scale * b:+.3g} ± {scale * s:.2g} {of}" for name, b, s, (of, scale) in rows]


@record
class SharedError:
    """One row of the table: an error that moves looks and known directions of targets."""

    names: tuple[str, ...]  # of its n unknowns
    columns_s: Callable[[PreparedStrip], Array] | None = None  # change (J, 3, n) of v_s by each; None: none
    columns_c: Callable[[PreparedStrip], Array] | None = None  # the same of u_c - w, frame c


@record(kw_only=True)
class SharedUnknowns:
    """The unknowns of a calibration beside theta, in the order of the information pairs' rows."""

    knots: tuple[distortion.Knot, ...] = scalar("of the cameras' distortion", default=())
    errors: tuple[SharedError, ...] = scalar("rows of the table; those of heads are last", default=())
    targets: tuple[str, ...] = array("T", "ids of the targets with unknown coordinates", default=())
    prior_targets: Array = scalar("(3 T, 3 T) information on these", default_factory=lambda: np.zeros((0, 0)))
    references: tuple[ReferenceField, ...] = scalar("offsets of ground references", default=())
    of_heads: tuple[str, ...] = scalar("names of the unknowns of heads", default=())

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns, in the order of the matrices."""
        return tuple(name for error in self.errors for name in error.names)

    def prior_information(self) -> Array:
        """Inverse prior covariance (n, n), each error in its unit."""
        return prior_of(self.names, self.prior_targets)

    def columns(self, strip: PreparedStrip) -> tuple[Array, Array]:
        """Change (J, 3, n) of u_c - w, frame c, and of v_s by all unknowns."""
        in_c, in_s = np.zeros((2, len(strip.v_s), 3, len(self.names)))
        last = 0
        for error in self.errors:
            first, last = last, last + len(error.names)
            for columns, out in ((error.columns_c, in_c), (error.columns_s, in_s)):
                if columns:
                    out[:, :, first:last] = columns(strip)
        return in_c, in_s

    def missed(self, strip: PreparedStrip) -> Array:
        """Variance (J,) of the cameras' distortion that straight lines between its knots miss, rad²."""
        share = distortion.missed_between_knots(_weights(strip, self.knots)) if self.knots else 1.0
        return np.asarray(strip.distortion_rad**2 * share)


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
    further: Sequence[SharedError] = (),
) -> SharedUnknowns:
    """The unknowns that these strips share, those of `heads` and `further` rows of the table among them;
    biases of orbit and clock where there are stars and targets on the ground.

    Of targets in several strips, those seen most often come first.
    """
    knots: set[distortion.Knot] = set()
    ccds: set[int] = set()
    for strip in strips:
        curved = strip.distortion_rad > 0.0
        knots.update(distortion.knots_touched(strip.curve[curved], strip.place[curved]))
        ccds.update(strip.unit[strip.modes_rad.any(axis=1)].tolist())
    count = Counter(name for strip in strips for name in np.unique(strip.ground.target_id).tolist())
    covariance = dict[str, Array]()
    for strip in reversed(strips):  # of a target that strips state otherwise, that of the first
        covariance |= zip(strip.ground.target_id[::-1].tolist(), strip.cov_coordinates[::-1])
    often = [name for name, n in count.items() if n > 1 and np.linalg.eigvalsh(covariance[name])[0] > 0.0]
    often.sort(key=lambda name: (-count[name], name))
    kept = tuple(sorted(often[: settings.most_shared_targets]))
    mixed = any(s.ground.is_star.any() for s in strips) and any(not s.ground.is_star.all() for s in strips)
    earth = tuple(sorted({strip.earth for strip in strips if strip.earth}))
    fields = fields_of(strips)
    return SharedUnknowns(
        knots=tuple(sorted(knots)),
        errors=(
            _distortion(tuple(sorted(knots)), tuple(sorted(ccds))),
            *further,
            SharedError(
                coordinate_names(kept),
                lambda one: of_each(one.coordinates_s, one.ground.target_id[:, None] == np.array(kept, str)),
            ),
            *([SharedError(BIASES, lambda strip: bias_columns(strip, settings))] if mixed else []),
            SharedError(
                earth_names(earth), lambda one: of_each(one.earth_s, np.array([earth], str) == one.earth)
            ),
            *map(_reference, fields),
            SharedError(heads, lambda one: of_heads(one.of_heads, one.by_heads_s, heads)),
        ),
        targets=kept,
        prior_targets=_in_blocks([np.asarray(np.linalg.inv(covariance[name]), float) for name in kept]),
        references=fields,
        of_heads=heads,
    )


def prior_of(names: Sequence[str], of_targets: Array) -> Array:
    """Prior information (n, n) of shared unknowns by their names, those of one kind one after another;
    `of_targets` (3 T, 3 T) is that of the coordinates.
    """
    priors = PRIORS | {"target": lambda _: of_targets}
    return _in_blocks([priors[kind](tuple(own)) for kind, own in groupby(names, key=_kind)])


def by_kind(names: Sequence[str]) -> tuple[str, ...]:
    """Names of shared unknowns in the order of the table."""
    return tuple(sorted(names, key=lambda name: list(PRIORS).index(_kind(name))))


def _kind(name: str) -> str:
    return name.partition("/")[0]


def _in_blocks(parts: Sequence[Array]) -> Array:
    """Matrices on the diagonal of one (n, n); none: (0, 0)."""
    return np.asarray(block_diag(np.zeros((0, 0)), *parts))


def _of_unit(names: Sequence[str]) -> Array:
    """Of unknowns in units of their 1-sigma; of other cameras' matrices, whose 1 rad is any."""
    return np.eye(len(names))


def _of_bias(names: Sequence[str]) -> Array:
    """Prior information (n, n) of these biases, in units of the stated errors."""
    return np.diag([PRIOR_SIGMA[name] ** -2.0 for name in names])


# Prior information on the unknowns of each kind by their names, which begin with it.
PRIORS: dict[str, Callable[[tuple[str, ...]], Array]] = {
    "distortion": distortion.prior_information,
    "interior": _of_unit,
    "target": _of_unit,  # if nothing else is known
    "bias": _of_bias,
    "earth": prior_of_predictions,
    "reference": _of_unit,
    "head": lambda names: np.eye(len(names)) / SIGMA_ALIGNMENT_RAD**2,
    "periodic": _of_unit,
    "camera": _of_unit,
}


def of_pass(strip: PreparedStrip, settings: CalibrationSettings) -> Array:
    """Change (J, 3, N) of v_s by the errors of one pass, or of passes that are still correlated: the position
    of the satellite (along the track, across it and in height, where it is a process) and the clock of the
    rows of each camera.
    """
    position = strip.move_s if settings.position_time_s else strip.move_i
    late, one = settings.sigma_clock_s * strip.late_s[:, :, None], np.zeros_like(strip.camera)
    moved = _process(settings.sigma_position_m * position, strip, settings.position_time_s, one)
    return np.concatenate([moved, _process(late, strip, settings.clock_time_s, strip.camera)], axis=2)


def bias_columns(strip: PreparedStrip, settings: CalibrationSettings) -> Array:
    """Change (J, 3, 4) of v_s by each of `BIASES` in units of the stated errors."""
    by_position = -settings.sigma_position_m * (strip.move_s * [1.0, 1.0, -1.0])
    return np.concatenate([by_position, -settings.sigma_clock_s * strip.late_s[:, :, None]], axis=2)


def common_bias(values: Array, covariance: Array, settings: CalibrationSettings) -> CommonBias | None:
    """The biases that the data determine, from values (4,) and covariance (4, 4) of `BIASES` in units of the
    stated errors; None if there are none.
    """
    prior = np.array([PRIOR_SIGMA[name] for name in BIASES])
    rows = np.flatnonzero(np.sqrt(np.diag(covariance)) <= OBSERVABLE * prior)
    if not len(rows):
        return None
    stated = np.array([settings.sigma_position_m] * 3 + [settings.sigma_clock_s])[rows]
    return CommonBias(
        names=tuple(BIASES[n].removeprefix("bias/") for n in rows),
        value=stated * values[rows],
        covariance=covariance[np.ix_(rows, rows)] * np.outer(stated, stated),
        stated=stated,
    )


def _process(columns: Array, strip: PreparedStrip, time_s: float, of: Ints) -> Array:
    """Change (J, 3, A M) of the targets' directions by a process, from that by an error at each target's own
    instant, (J, 3, A): its M independent parts of unit variance; processes of different `of` (J,) are
    independent.
    """
    if time_s:
        apart = np.abs(strip.ground.t_s[:, None] - strip.ground.t_s)
        values, vectors = np.linalg.eigh((of[:, None] == of) * np.exp(-apart / time_s))
        large = values > NO_EFFECT * values[-1:]
        root = vectors[:, large] * np.sqrt(values[large])
    else:
        own = np.unique(np.column_stack([strip.number, of]), axis=0, return_inverse=True)[1]
        root = np.eye(int(own.max(initial=-1)) + 1)[own]
    return np.asarray((columns[:, :, :, None] * root[:, None, None, :]).reshape(*columns.shape[:2], -1))


def _distortion(knots: tuple[distortion.Knot, ...], ccds: tuple[int, ...]) -> SharedError:
    def columns(strip: PreparedStrip) -> Array:
        of_knots = strip.distortion_rad[:, None] * _weights(strip, knots)
        of_ccd = strip.unit[:, None] == np.array(ccds, dtype=np.int64)
        of_modes = strip.modes_rad[:, :, None] * of_ccd[:, None, :]
        along = np.column_stack([of_knots, of_modes.reshape(len(of_knots), -1)])
        return (np.eye(3, 2)[:, :, None] * along[:, None, None]).reshape(len(along), 3, -1)

    return SharedError(distortion.unknown_names(knots, ccds), columns_c=columns)


def _reference(field: ReferenceField) -> SharedError:
    return SharedError(field.names, lambda one: of_each(one.reference_s * field.sigma_m, field.weights(one)))


def _weights(strip: PreparedStrip, knots: tuple[distortion.Knot, ...]) -> Array:
    """Weights (J, K) of knots in the distortion of each target; zero where its camera has none."""
    curved, weights = strip.distortion_rad > 0.0, np.zeros((len(strip.v_s), len(knots)))
    weights[curved] = distortion.knot_weights(strip.curve[curved], strip.place[curved], knots)
    return weights


def of_each(change: Array, weights: Array | Bools) -> Array:
    """Changes (J, 3, M n) by M errors of n unknowns each, from those by the unknowns of one (J, 3, n) and the
    parts (J, M) of the errors in that of each target.
    """
    return (weights[:, None, :, None] * change[:, :, None, :]).reshape(*change.shape[:2], -1)
