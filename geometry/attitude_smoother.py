"""Attitude over a pass as a process: the rows of all star cameras, smoothed, with the covariance between
instants.

Relative to the nominal motion, about its axes o, the satellite's rotation x has a rate v, which is a random
walk of density q about each axis; every head h has an error g_h about its own axes n, of correlation
exp(-|t - t'| / τ), and one that is constant over the pass, b_h about the axes of s (alignment, slow errors):

    dx = v dt,   dv = white noise of density q,   a row of head h:  y = R_so x + R_sn g_h + b_h + white noise.

A gyro is one more head, whose error and bias begin anywhere and grow as `geometry.gyro` says. The states
at the rows' instants are a Markov chain, their information matrix is block tridiagonal, and its Cholesky
factor costs time in proportion to the rows. Between two rows x is the cubic through x and v of both, but for
a bridge of known covariance. All is linear in the constants, which stay open: the rows tell the states given
b, their change by b, and something about b itself. Angles in radians, times in seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag, cho_solve_banded, cholesky_banded
from scipy.linalg.lapack import dpstrf, dtbtrs
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack, NominalMotion
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.geometry.gyro import GyroNoise, GyroRows
from boresight.records.record import Bools, Floats, Ints, RowRecord, array, record, scalar

__all__ = ["HeadRows", "SmoothedAttitude", "most_likely_motion", "smoothed_track"]

ORDER = 2  # states of the motion about an axis: rotation and rate
MOTION = 3 * ORDER  # of all axes
MERGED = 0.3  # of the usual step: rows nearer together share a node
ALONE_S = 0.5  # step where every head has one row
DIFFUSE_RAD = 1.0  # 1-sigma of constants of which nothing is known
DIFFUSE = 1e3  # the same of rotation and rate before the first row, in units of a row's error and steps
# Knots of each step of the nodes, between which errors of the attitude are linear: at least so many, to 1 %
# of errors that go to and fro in four steps, and as many as leave less than `STRAIGHT_RAD` of the motion.
KNOTS = 4
STRAIGHT_RAD = 0.05 * ARCSEC  # half of the vibration of the paper's Table 1
NEGLIGIBLE = 1e-4  # of the largest variance of a rotation: less is left out of a root
WINDOWS = 2.0 ** np.arange(-2.0, 6.0)  # steps over which a motion would let rows be averaged, that are tried
NEAR = 2.0 ** np.arange(-3.0, 3.1, 0.5)  # of the best for all axes, for each axis by itself
SPREAD = 2.5  # 1-sigma of the logarithm of q about the stated one
UNLIKE = 1.5  # the same of an axis about that of all: axes of one satellite move somewhat alike
MOST_NODES = 240  # that are asked for the motion; more would not change it


@record(kw_only=True)
class HeadRows(RowRecord):
    """Attitudes of one head over a pass, turned to frame s by its alignment as far as that is known."""

    t_s: Floats = array("K", "instants, increasing, TAI seconds since the epoch")
    R_so: Rotation = array("K", "nominal frame to frame s")
    covariance_s: Floats = array("K, 3, 3", "of the white part of each error, rad²")
    noise: AttitudeNoise = scalar("the correlated and the constant part; its `R_sn` leads to frame s")
    name: str = scalar("of the head", default="")

    def within(self, first_s: float, last_s: float) -> HeadRows:
        """The rows from one instant to another."""
        return self.take(slice(*np.searchsorted(self.t_s, [first_s, last_s])))


@record
class _Nodes:
    """What the rows of H heads say of the states at N nodes, D each: x, v, errors g of all heads, error and
    bias of a gyro.
    """

    t_s: Floats  # (N,) instants
    begins: Bools  # (N,) nodes that begin a pass, whose state nothing before tells
    information: Floats  # (N, D, D) on the states
    by_rows: Floats  # (N, D, 1 + 3 H) right-hand sides: by the rows, by the constants of each head
    squares: Floats  # (1 + 3 H, 1 + 3 H) weighted sums of squares of the same
    variance: Floats  # of the errors g
    time_s: Floats  # their correlation times
    drift: GyroNoise | None  # of the gyro
    trend: Floats  # (ORDER, 3) rotation and rate at the first node that are taken out of the rows
    step_s: float  # usual step of the head of the fewest rows
    white2: float  # usual variance of the white part, rad²

    @classmethod
    def of(cls, heads: Sequence[HeadRows], middle: Rotation, gyro: GyroRows | None = None) -> _Nodes:
        """Nodes at the rows, and one step before and after; `middle` is an attitude R_so near all of them."""
        step = max((float(np.median(np.diff(h.t_s))) for h in heads if len(h.t_s) > 1), default=ALONE_S)
        every = np.sort(np.concatenate([head.t_s for head in heads] + ([gyro.t_s] if gyro else [])))
        first = every[_group_starts(every, MERGED * min(step, gyro.step_s if gyro else step))]
        t_s = np.concatenate([[first[0] - step], first, [first[-1] + step]])
        R_so, axes = middle.as_matrix(), [np.flatnonzero(head.noise.correlated_rad > 0.0) for head in heads]
        turns = [(head.R_so * middle.inv()).as_rotvec() for head in heads]
        rows = [
            (head.t_s, turn, head.noise.R_sn.as_matrix()[:, own], np.linalg.inv(head.covariance_s))
            for head, turn, own in zip(heads, turns, axes)
        ]
        if gyro:
            own_s = np.tile(gyro.noise.white_rad**2 * np.eye(3), (len(gyro.t_s), 1, 1))
            told = gyro.path(heads[0].t_s, turns[0], middle)
            rows.append((gyro.t_s, told, np.zeros((3, 0)), np.linalg.inv(own_s)))
        D, m = MOTION * (2 if gyro else 1) + sum(map(len, axes)), 1 + 3 * len(heads)
        information, by_rows = np.zeros((len(t_s), D, D)), np.zeros((len(t_s), D, m))
        squares, column = np.zeros((m, m)), MOTION
        trend = np.linalg.lstsq(_step(heads[0].t_s - t_s[0])[:, 0], turns[0] @ R_so, rcond=None)[0]
        for h, (t, turn, own, W) in enumerate(rows):
            at = np.searchsorted(t_s, t, side="right") - 1
            H, y = np.zeros((len(at), 3, D)), np.zeros((len(at), 3, m))
            H[:, :, :MOTION] = np.kron(_step(t - t_s[at])[:, :1], R_so)
            y[:, :, 0] = turn - _step(t - t_s[0])[:, 0] @ trend @ R_so.T
            if h < len(heads):
                H[:, :, column : column + own.shape[1]] = own
                y[:, :, 1 + 3 * h : 4 + 3 * h] = np.eye(3)
                column += own.shape[1]
            else:  # the error of a gyro is, about the axes of o, one more motion
                H[:, :, column:] = H[:, :, :MOTION]
            HtW = np.swapaxes(H, 1, 2) @ W
            np.add.at(information, at, HtW @ H)
            np.add.at(by_rows, at, HtW @ y)
            squares += np.tensordot(y, W @ y, axes=([0, 1], [0, 1]))
        return cls(
            t_s=t_s,
            begins=np.arange(len(t_s)) == 0,
            information=information,
            by_rows=by_rows,
            squares=squares,
            variance=np.concatenate([h.noise.correlated_rad[own] ** 2 for h, own in zip(heads, axes)]),
            time_s=np.concatenate([h.noise.correlation_time_s[own] for h, own in zip(heads, axes)]),
            drift=gyro.noise if gyro else None,
            trend=trend,
            step_s=step,
            white2=float(np.median(np.trace(heads[0].covariance_s, axis1=1, axis2=2)) / 3.0),
        )

    @classmethod
    def together(cls, parts: Sequence[_Nodes]) -> _Nodes:
        """Several passes one after another, each beginning anew; of heads with errors of equal sizes."""
        names = ("t_s", "begins", "information", "by_rows")
        return replace(
            parts[0],
            squares=sum((part.squares for part in parts), np.zeros_like(parts[0].squares)),
            **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names},
        )


def _group_starts(t_s: Floats, reach_s: float) -> Ints:
    """Rows of increasing instants (K,) that begin a group at most `reach_s` long."""
    rows = [0]
    while (after := int(np.searchsorted(t_s, t_s[rows[-1]] + reach_s, side="right"))) < len(t_s):
        rows.append(after)
    return np.array(rows, dtype=np.int64)


@record
class _Equations:
    """Equations for the states at nodes: linear in one over the densities q of the motion."""

    nodes: _Nodes
    fixed: Floats  # (2 D, N, D) banded information on the states that does not depend on q
    moving: Floats  # (2 D, N, MOTION) that of the motion's walks, each q being 1: a column has its own axis
    size: float  # logarithm of the prior's determinant, each q being 1
    steps: int  # from node to node

    @classmethod
    def of(cls, nodes: _Nodes) -> _Equations:
        """With the processes between the nodes as prior."""
        N, D, _ = nodes.information.shape
        goes = ~nodes.begins[1:]
        dt = np.diff(nodes.t_s)[goes, None]
        F, first = _step(dt[:, 0]), np.flatnonzero(nodes.begins)[:, None]
        loose2 = DIFFUSE**2 * nodes.white2 * nodes.step_s ** (-2.0 * np.repeat(np.arange(ORDER), 3))
        fixed, moving = ((np.zeros((N, D, D)), np.zeros((N - 1, D, D))) for _ in range(2))
        walks = [(moving, 0, _spread(dt[:, 0], INVERSE, -1.0)[..., None] * np.ones(3), loose2)]
        if nodes.drift is not None:
            of_gyro = np.linalg.inv(nodes.drift.spread(dt[:, 0]))[..., None] * np.ones(3)
            bias2 = np.where(np.arange(MOTION) < 3, loose2, nodes.drift.bias_rad_s**2)
            walks.append((fixed, D - MOTION, of_gyro, bias2))
        g = MOTION + np.arange(len(nodes.variance))
        decay = np.exp(-dt / nodes.time_s)
        spread = -np.expm1(-2.0 * dt / nodes.time_s) * nodes.variance
        before, after = np.flatnonzero(goes)[:, None], np.flatnonzero(goes)[:, None] + 1
        size = -np.log(spread).sum() - len(first) * np.log(nodes.variance).sum()
        for (diagonal, below), column, Q_inverse, begin2 in walks:
            back = -np.einsum("nija,njk->nika", Q_inverse, F)
            told = -np.einsum("nji,njka->nika", F, back)
            for i, k in np.ndindex(ORDER, ORDER):
                rows, columns = column + np.arange(3) + 3 * i, column + np.arange(3) + 3 * k
                diagonal[before, rows, columns] += told[:, i, k]
                diagonal[after, rows, columns] += Q_inverse[:, i, k]
                below[before, rows, columns] = back[:, i, k]
            own = column + np.arange(MOTION)
            fixed[0][first, own, own] += 1.0 / begin2
            size += np.linalg.slogdet(np.moveaxis(Q_inverse, 3, 1))[1].sum()
            size -= len(first) * np.log(begin2).sum()
        diagonal, below = fixed
        diagonal += nodes.information
        diagonal[before, g, g] += decay**2 / spread
        diagonal[after, g, g] += 1.0 / spread
        below[before, g, g] = -decay / spread
        diagonal[first, g, g] += 1.0 / nodes.variance
        of_motion = np.ascontiguousarray(_banded(*moving)[:, :, :MOTION])
        return cls(nodes, _banded(*fixed), of_motion, float(size), len(dt))

    def solved(self, q: Floats) -> tuple[Floats, Floats, Floats]:
        """For densities (3,): lower Cholesky factor, banded (2 D, N D); states (N, D, 1 + 3 H) by rows and
        constants; and what is left of the sums of squares, (1 + 3 H, 1 + 3 H).
        """
        factor, right = self._factored(q)
        states = np.asarray(cho_solve_banded((factor, True), right))
        left = self.nodes.squares - right.T @ states
        return factor, states.reshape(self.nodes.by_rows.shape), 0.5 * (left + left.T)

    def log_likelihood(self, q: Floats) -> float:
        """Logarithm of the likelihood for densities (3,), the constants unknown."""
        factor, right = self._factored(q)
        told, _ = dtbtrs(factor, right, uplo="L")
        left = self.nodes.squares - told.T @ told
        known = left[1:, 1:] + np.eye(len(left) - 1) / DIFFUSE_RAD**2
        chi2 = left[0, 0] - left[0, 1:] @ np.linalg.solve(known, left[1:, 0])
        of_prior = self.size - ORDER * self.steps * np.log(q).sum()
        size = 2.0 * np.log(factor[0]).sum() - of_prior + np.linalg.slogdet(known)[1]
        return -0.5 * float(size + chi2)

    def _factored(self, q: Floats) -> tuple[Floats, Floats]:
        """The factor for densities (3,), and right-hand sides (N D, 1 + 3 H)."""
        N, D, m = self.nodes.by_rows.shape
        band = self.fixed.copy()
        band[:, :, :MOTION] += self.moving / np.tile(q, ORDER)
        factor = cholesky_banded(band.reshape(2 * D, N * D), overwrite_ab=True, lower=True)
        return np.asarray(factor), self.nodes.by_rows.reshape(N * D, m)


# Of the motion over one second, q being 1: covariance of the states given those before, and its inverse.
_POWER: Ints = np.array([[3, 2], [2, 1]])
COVARIANCE: Floats = np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]])
INVERSE: Floats = np.asarray(np.linalg.inv(COVARIANCE), dtype=np.float64)


def _step(dt: Floats) -> Floats:
    """(N, ORDER, ORDER) by which x and v become those `dt` (N,) later."""
    step = np.tile(np.eye(ORDER), (len(dt), 1, 1))
    step[:, 0, 1] = dt
    return step


def _spread(dt: Floats, of_second: Floats, sign: float = 1.0) -> Floats:
    """(N, ORDER, ORDER) covariance of x and v `dt` (N,) later from that after a second, or the inverse."""
    return np.asarray(of_second * dt[:, None, None] ** (sign * _POWER))


def _banded(diagonal: Floats, below: Floats) -> Floats:
    """Lower band (2 D, N, D) of the matrix of blocks (N, D, D) and those below them (N - 1, D, D)."""
    N, D, _ = diagonal.shape
    band = np.zeros((2 * D, N, D))
    for column in range(D):
        band[: D - column, :, column] = diagonal[:, column:, column].T
        band[D - column : 2 * D - column, :-1, column] = below[:, :, column].T
    return band


def most_likely_motion(
    passes: Sequence[Sequence[HeadRows]], gyros: Sequence[GyroRows | None] = (), *, stated: float = 0.0
) -> Floats:
    """Densities q (3,) of the rates' random walks, rad²/s³, given the rows of passes of one
    satellite, with a wide prior about a `stated` one; 0: none. `gyros`: of each pass, or of none.
    """
    share = max(MOST_NODES // len(passes), 8)
    every_one = list(zip(passes, gyros or [None] * len(passes)))
    chosen = every_one[:: -(-len(passes) * 8 // MOST_NODES)]
    groups = dict[tuple[object, ...], list[_Nodes]]()  # of passes with the same heads
    for one in (_centred(heads, share, gyro) for heads, gyro in chosen):
        kind = (one.by_rows.shape[1:], one.drift, *one.variance.tolist(), *one.time_s.tolist())
        groups.setdefault(kind, []).append(one)
    nodes = _Nodes.together(max(groups.values(), key=lambda group: sum(len(one.t_s) for one in group)))
    equations = _Equations.of(nodes)

    def posterior(q: Floats) -> float:
        away = np.log(q / stated) / SPREAD if stated else np.zeros(3)
        return equations.log_likelihood(q) - 0.5 * float(away @ away)

    scale, every = nodes.white2 * nodes.step_s ** (1 - 2 * ORDER), np.arange(3)
    alike = scale / WINDOWS ** (2 * ORDER)
    usual = float(alike[np.argmax([posterior(np.full(3, one)) for one in alike])])
    q = np.full(3, usual)
    for axis in range(3):
        tried = usual / NEAR ** (2 * ORDER)
        fit = np.array([posterior(np.where(every == axis, one, q)) for one in tried])
        fit -= 0.5 * (np.log(tried / usual) / UNLIKE) ** 2
        weight = np.exp(fit - fit.max())
        q[axis] = np.exp(np.log(tried) @ weight / weight.sum())
    return q


def _centred(heads: Sequence[HeadRows], most: int, gyro: GyroRows | None) -> _Nodes:
    """Nodes of the middle of a pass, the heads brought together in the mean."""
    t_s = heads[0].t_s
    here = t_s[max((len(t_s) - most) // 2, 0) :][:most]
    parts = [one for head in heads if len((one := head.within(here[0], here[-1] + 1e-9)).t_s)]
    middle = parts[0].R_so[len(here) // 2]
    turns = [(part.R_so * middle.inv()).as_rotvec() for part in parts]
    around = [np.array([np.interp(p.t_s, parts[0].t_s, turns[0][:, k]) for k in range(3)]).T for p in parts]
    off = [np.mean(turn - one, axis=0) for turn, one in zip(turns, around)]
    moved = [replace(p, R_so=Rotation.from_rotvec(-by) * p.R_so) for p, by in zip(parts, off)]
    near = gyro and gyro.within(here[0] - gyro.step_s, here[-1] + gyro.step_s)
    return _Nodes.of(moved, middle, near)


@record
class SmoothedAttitude:
    """The attitude over a pass as the rows of H heads tell it, at N nodes."""

    t_s: Floats  # (N,) instants of the nodes
    middle: Rotation  # R_so about which x is small
    states: Floats  # (N, MOTION, 1 + 3 H) x, v; their change by the constants of each head
    back: Floats  # (N - 1, D, D) by which a state follows from the next one
    full: Floats  # (N, D, D) covariance of the states, the constants given
    q: Floats  # (3,) density of the rates' random walks, rad²/s³
    constants: Floats  # (m, 1 + 3 H) rows r, T of unit variance: r = T b + noise, of the constants b
    chi2: float  # weighted sum of squares that the best states and constants leave
    dof: int  # its degrees of freedom

    @classmethod
    def of(cls, heads: Sequence[HeadRows], q: Floats, gyro: GyroRows | None = None) -> SmoothedAttitude:
        """By the rows of H heads, the first with at least one, and of a gyro; `q` (3,) as above."""
        middle = heads[0].R_so[len(heads[0].t_s) // 2]
        nodes = _Nodes.of(heads, middle, gyro)
        factor, states, left = _Equations.of(nodes).solved(q)
        N, D, _ = states.shape
        L, below = _blocks(factor, N, D)
        back = -np.linalg.solve(np.swapaxes(L[:-1], 1, 2), np.swapaxes(below, 1, 2))
        own = np.linalg.inv(L)
        full = np.swapaxes(own, 1, 2) @ own  # of each state, the next one given
        for k in range(N - 2, -1, -1):
            full[k] += back[k] @ full[k + 1] @ back[k].T
        values, vectors = np.linalg.eigh(left[1:, 1:])
        seen = slice(3, None)  # a constant that all heads have in common is not seen
        root = np.sqrt(np.maximum(values[seen], DIFFUSE_RAD**-2))
        r, T = (vectors[:, seen].T @ left[1:, 0]) / root, root[:, None] * vectors[:, seen].T
        rows = sum(len(head.t_s) for head in heads) + (len(gyro.t_s) - ORDER if gyro else 0)
        of_motion = states[:, :MOTION] * np.where(np.arange(states.shape[2]), -1.0, 1.0)
        of_motion[:, :, 0] += (_step(nodes.t_s - nodes.t_s[0]) @ nodes.trend).reshape(N, MOTION)
        return cls(
            t_s=nodes.t_s,
            middle=middle,
            states=of_motion,
            back=np.asarray(back, dtype=float),
            full=full,
            q=q,
            constants=np.column_stack([r, T]),
            chi2=max(float(left[0, 0] - r @ r), 0.0),
            dof=max(3 * rows - MOTION - len(r), 0),
        )

    def R_so(self, t_s: Floats) -> Rotation:
        """Nominal frame to frame s at instants (J,) from a step before the first row to one after the last,
        without constant errors.
        """
        return Rotation.from_rotvec(self._mean(t_s)[:, :, 0]) * self.middle

    def by_constants(self, t_s: Floats) -> Floats:
        """Rotation (J, 3, 3 H) about the axes of s, at instants (J,), by the constants of each head."""
        return self._mean(t_s)[:, :, 1:]

    def covariance_s(self, t_s: Floats) -> Floats:
        """Covariance (J, 3, 3), rad², of the rotation about the axes of s at instants (J,), b given."""
        k, here, after, s = self._around(t_s)
        both = self.back[k] @ self.full[k + 1]  # of a state with the next one
        cross = here @ both @ np.swapaxes(after, 1, 2)
        total = here @ self.full[k] @ np.swapaxes(here, 1, 2) + cross + np.swapaxes(cross, 1, 2)
        total += after @ self.full[k + 1] @ np.swapaxes(after, 1, 2)
        total += self._bridge(k, s, s)[:, None, None] * np.diag(self.q)
        M = self.middle.as_matrix()
        return np.asarray(M @ total @ M.T)

    def root_s(self, t_s: Floats) -> Floats:
        """Rotation (J, 3, n) about the axes of s, at instants (J,), by n independent errors of unit variance:
        a root of the joint covariance, the constants given. More instants than knots are linear between them.
        """
        k, share = self._steps_of(t_s)
        steps, own = np.unique(k, return_inverse=True)
        dt = np.diff(self.t_s)[steps]
        straight_s = np.cbrt(
            48.0 * STRAIGHT_RAD**2 / self.q.max()
        )  # pinned at both ends, q s³ / 48 in the middle
        parts = np.maximum(np.ceil(dt / straight_s).astype(np.int64), KNOTS)
        if len(t_s) <= parts.sum():
            return self._root_at(t_s)
        begin, step = np.cumsum(parts + 1) - parts - 1, np.repeat(np.arange(len(steps)), parts + 1)
        places = (np.arange(len(step)) - begin[step]) / parts[step]
        knots, at = np.unique(self.t_s[steps][step] + places * dt[step], return_inverse=True)
        before = np.minimum((share * parts[own]).astype(np.int64), parts[own] - 1)
        ahead, left = share * parts[own] - before, begin[own] + before
        weights = np.column_stack([1.0 - ahead, ahead]).ravel()
        columns = np.column_stack([at[left], at[left + 1]]).ravel()
        between = csr_array((weights, columns, 2 * np.arange(len(t_s) + 1)), shape=(len(t_s), len(knots)))
        return np.asarray((between @ self._root_at(knots).reshape(len(knots), -1)).reshape(len(t_s), 3, -1))

    def _root_at(self, t_s: Floats) -> Floats:
        J, D = len(t_s), self.full.shape[1]
        k, here, after, s = self._around(t_s)
        joint = np.zeros((3 * J, 3 * J))
        known, done = np.zeros((D, 0)), np.zeros(0, dtype=np.int64)  # a state with rotations later than it
        last = len(self.t_s) - 1
        for node in np.unique(k)[::-1].tolist():
            here_of = np.flatnonzero(k == node)
            rows = (3 * here_of[:, None] + np.arange(3)).ravel()
            between = np.eye(D)
            for later in range(last - 1, node, -1):
                between = self.back[later] @ between
            next_one = between @ known
            both = self.back[node] @ self.full[node + 1]
            A, B = here[here_of].reshape(-1, D), after[here_of].reshape(-1, D)
            cross = A @ both @ B.T
            own = A @ self.full[node] @ A.T + B @ self.full[node + 1] @ B.T + cross + cross.T
            bridge = self._bridge(np.array([node]), s[here_of, None], s[here_of])
            joint[np.ix_(rows, rows)] = own + np.kron(bridge, np.diag(self.q))
            known = self.back[node] @ next_one
            with_later = A @ known + B @ next_one
            joint[np.ix_(rows, done)], joint[np.ix_(done, rows)] = with_later, with_later.T
            known = np.column_stack([known, self.full[node] @ A.T + both @ B.T])
            done, last = np.concatenate([done, rows]), node
        largest = float(np.max(np.diag(joint), initial=0.0))
        root, order, rank, _ = dpstrf(joint, tol=NEGLIGIBLE * largest, lower=1)
        found = np.zeros((3 * J, rank))
        found[order - 1] = np.tril(root)[:, :rank]
        return np.asarray(self.middle.as_matrix() @ found.reshape(J, 3, rank))

    def _mean(self, t_s: Floats) -> Floats:
        """Rotation (J, 3, 1 + 3 H) about the axes of s: as estimated, and by the constants."""
        k, here, after, _ = self._around(t_s)
        both = here[:, :, :MOTION] @ self.states[k] + after[:, :, :MOTION] @ self.states[k + 1]
        return np.asarray(self.middle.as_matrix() @ both)

    def _around(self, t_s: Floats) -> tuple[Ints, Floats, Floats, Floats]:
        """Node (J,) before each instant, the shares (J, 3, D) of its state and of the next one in the
        rotation, and the seconds (J,) since it; `ValueError` for an instant beyond the nodes.
        """
        outside = ~((t_s >= self.t_s[0]) & (t_s <= self.t_s[-1]))
        if np.any(outside):
            span = f"{self.t_s[0]:.6f} ... {self.t_s[-1]:.6f} s"
            raise ValueError(f"{outside.sum()} of {len(t_s)} instants lie outside the attitudes: {span}")
        k, share = self._steps_of(t_s)
        dt = self.t_s[k + 1] - self.t_s[k]
        s = share * dt
        by_after = _pinned(s, dt)
        by_here = _step(s)[:, 0] - (by_after[:, None] @ _step(dt))[:, 0]
        here, after = np.zeros((2, len(t_s), 3, self.full.shape[1]))
        for axis in range(3):
            here[:, axis, axis:MOTION:3], after[:, axis, axis:MOTION:3] = by_here, by_after
        return k, here, after, s

    def _steps_of(self, t_s: Floats) -> tuple[Ints, Floats]:
        """Node (J,) before each instant, and the share (J,) of the step to the next that has passed."""
        k = np.clip(np.searchsorted(self.t_s, t_s, side="right") - 1, 0, len(self.t_s) - 2)
        return k, (t_s - self.t_s[k]) / (self.t_s[k + 1] - self.t_s[k])

    def _bridge(self, k: Ints, s: Floats, u: Floats) -> Floats:
        """Covariance for q = 1 of the rotations s and u seconds after node k, the states at k and the next
        given.
        """
        shape = np.broadcast_shapes(k.shape, s.shape, u.shape)
        k, s, u = (one.ravel() for one in np.broadcast_arrays(k, s, u))
        dt = self.t_s[k + 1] - self.t_s[k]
        first, last = np.minimum(s, u), np.maximum(s, u)
        free = np.einsum("ni,ni->n", _spread(first, COVARIANCE)[:, 0], _step(last - first)[:, 0])
        by_next = np.einsum("ni,nik,nk->n", _pinned(s, dt), _spread(dt, COVARIANCE), _pinned(u, dt))
        return np.asarray(free - by_next).reshape(shape)


def _pinned(s: Floats, dt: Floats) -> Floats:
    """Shares (J, ORDER) of the states at the next node, `dt` after one, in the rotation `s` after it."""
    left = _spread(s, COVARIANCE)[:, :1] @ np.swapaxes(_step(dt - s), 1, 2)
    return np.asarray((left @ _spread(dt, INVERSE, -1.0))[:, 0])


def smoothed_track(
    heads: Sequence[HeadRows],
    nominal: NominalMotion,
    sigma_alignment_rad: float = 0.0,
    gyro: GyroRows | None = None,
    t_s: Floats | None = None,
) -> AttitudeTrack:
    """The attitudes in the axes of the first of some heads by the rows of all, at instants (K,): by default
    its own. Alignments of the others are known to `sigma_alignment_rad`, 1-sigma.
    """
    found = SmoothedAttitude.of(heads, most_likely_motion([heads], [gyro]), gyro)
    t_s = heads[0].t_s if t_s is None else t_s
    known = block_diag(*(head.noise.lasting_covariance_s for head in heads))
    known[3:, 3:] += sigma_alignment_rad**2 * np.eye(len(known) - 3)
    r, T = found.constants[:, 0], found.constants[:, 1:]
    gain = np.linalg.solve(T @ known @ T.T + np.eye(len(r)), T @ known).T
    left, by_constants = known - gain @ T @ known, found.by_constants(t_s)
    R_so = Rotation.from_rotvec(by_constants @ (gain @ r)) * found.R_so(t_s)
    covariance = found.covariance_s(t_s) + by_constants @ left @ np.swapaxes(by_constants, 1, 2)
    values, vectors = np.linalg.eigh(left)
    of_constants = vectors * np.sqrt(np.maximum(values, 0.0))

    def errors(at: Floats) -> Floats:
        return np.concatenate([found.root_s(at), found.by_constants(at) @ of_constants], axis=2)

    R_si = R_so * nominal.R_oi(t_s)
    share = -by_constants.mean(axis=0) @ (np.eye(len(known)) - gain @ T)
    shares = {head.name: share[:, 3 * n : 3 * n + 3] for n, head in enumerate(heads)}
    return AttitudeTrack(
        t_s, R_si, nominal, covariance, is_smoothed=True, smoothed_errors=errors, shares=shares
    )


def _blocks(factor: Floats, N: int, D: int) -> tuple[Floats, Floats]:
    """Blocks (N, D, D) on the diagonal of a banded factor (2 D, N D), and those below them (N - 1, D, D)."""
    band = factor.reshape(2 * D, N, D)
    diagonal, below = np.zeros((N, D, D)), np.zeros((N - 1, D, D))
    for column in range(D):
        diagonal[:, column:, column] = band[: D - column, :, column].T
        below[:, :, column] = band[D - column : 2 * D - column, :-1, column].T
    return diagonal, below
