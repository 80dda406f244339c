"""Missions drawn from the information of one result: each has its own noise, all share one camera."""

import dataclasses
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs
from boresight.features.mission.mounting_course import YEAR_S, MountingSeries, annual_columns
from boresight.features.mission.saved_mounting import SavedMounting, utc_at
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta

R_CS = Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
SHARED = tuple(f"distortion/{axis}/0/{node}" for axis in "xy" for node in (-1, 0, 1))


def lopsided_pair(seed=0):
    """1 sigma of 0.3 to 0.4" in two directions and 2" in a third, turned; the distortion moves theta."""
    rng = np.random.default_rng(seed)
    Q = Rotation.random(random_state=rng).as_matrix()
    C = Q @ np.diag((np.array([0.3, 0.4, 2.0]) * ARCSEC) ** 2) @ Q.T
    F = np.zeros((9, 9))
    F[:3, :3] = np.linalg.inv(C)
    gain = rng.normal(size=(3, 6)) * 0.4 * ARCSEC  # of theta, a unit of the distortion
    F[:3, 3:] = F[:3, :3] @ gain
    F[3:, :3] = F[:3, 3:].T
    F[3:, 3:] = gain.T @ F[:3, :3] @ gain + 2.0 * np.eye(6)
    return InformationPairs(np.array(["r"]), F[None], np.zeros((1, 9)), R_CS, SHARED)


class DrawnMission:
    """Results of one camera, whose distortion is drawn once."""

    def __init__(self, pair, rng):
        self.pair, self.rng, self.F = pair, rng, pair.F[0]
        self.prior = prior_information(pair.shared)
        values, vectors = np.linalg.eigh(self.F)
        self.root = vectors * np.sqrt(np.maximum(values, 0.0))
        self.shared = np.linalg.cholesky(np.linalg.inv(self.prior)) @ rng.normal(size=len(self.prior))

    def right(self, theta, scale=1.0):
        """Right-hand sides (K, n) of results of theta (K, 3), rad, with `scale` times the information."""
        x = np.concatenate([theta, np.tile(self.shared, (len(theta), 1))], axis=1)
        return scale * x @ self.F + np.sqrt(scale) * self.rng.normal(size=x.shape) @ self.root.T

    def series(self, t_s, theta, cos_sin=None, beta=None, temperature=None, exchanges=()):
        """A series of results at t_s (K,)."""
        K, b = len(t_s), self.right(theta)
        nan = np.full(K, np.nan)
        return MountingSeries(
            names=tuple(f"r{k:03d}" for k in range(K)),
            t_s=t_s,
            F=np.tile(self.F[:3, :3], (K, 1, 1)),
            F_shared=np.tile(self.F[:3, 3:], (K, 1, 1)),
            right=b[:, :3],
            shared_F=K * self.F[3:, 3:] + self.prior,
            shared_right=b[:, 3:].sum(axis=0),
            cos_sin=np.column_stack([nan, nan]) if cos_sin is None else cos_sin,
            beta_rad=nan if beta is None else beta,
            temperature_c=nan if temperature is None else temperature,
            exchanges=exchanges,
        )

    def result(self, like: SavedMounting, name: str, t_s: float, theta, scale=1.0, **changes):
        """A result like another, of theta (3,)."""
        (b,) = self.right(np.atleast_2d(theta), scale)
        N = scale * self.F
        N[3:, 3:] += self.prior
        values = {
            "id": name,
            "t_s": t_s,
            "utc": utc_at(t_s),
            "R_cs": deviation_from_theta(np.linalg.solve(N, b)[:3]) * self.pair.R_cs_ref,
            "covariance": np.linalg.inv(N)[:3, :3],
            "pair": InformationPairs(
                np.array([name]), scale * self.F[None], b[None], self.pair.R_cs_ref, self.pair.shared
            ),
            "strips": np.array(["s1"]),
            "strips_utc": np.array([utc_at(t_s)]),
            "track_deg": np.array([[50.0, 10.0, 49.0, 9.8]]),
        }
        return dataclasses.replace(like, **(values | changes))


def joint_information(series):
    """Information (3 K, 3 K) on theta of all results, shared unknowns integrated out, and right-hand side."""
    K = len(series.t_s)
    cross = series.F_shared.reshape(3 * K, -1)
    L = np.zeros((3 * K, 3 * K))
    for k in range(K):
        L[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] = series.F[k]
    L -= cross @ np.linalg.solve(series.shared_F, cross.T)
    return L, series.right.ravel() - cross @ np.linalg.solve(series.shared_F, series.shared_right)


def bare_result(pair=None):
    """A result without files, as the first of a mission."""
    pair = lopsided_pair() if pair is None else pair
    return SavedMounting(
        id="0",
        folder=Path("result").resolve(),
        t_s=0.0,
        utc=utc_at(0.0),
        mission="drawn",
        satellite="",
        camera="",
        head="",
        star_camera="A",
        model="m",
        verdict="consistent",
        R_cs=pair.R_cs_ref,
        R_cs0=pair.R_cs_ref,
        covariance=np.eye(3),
        ground_m_per_rad=np.array([5e5, 5e5, 6e3]),
        pair=pair,
        cos_sin=np.array([1.0, 0.0]),
        beta_rad=0.1,
        temperature_c=np.nan,
        strips=np.array(["s1"]),
        strips_utc=np.array([utc_at(0.0)]),
        track_deg=np.full((1, 4), np.nan),
        facts={"program": "boresight 0", "inputs": "i", "dump": "d"},
    )


class Truth:
    """Three years: annual 3", orbit phase 5", steps of 1" and 0.5" at two results."""

    def __init__(self, rng, results=160, one_sided=False, annual=3.0, orbit=5.0, steps=(1.0, 0.5)):
        self.t_s = np.sort(rng.uniform(0.0, 3.0 * YEAR_S, results))
        if one_sided:  # a dump in ten days, of one side of a sun-synchronous orbit
            self.t_s = np.arange(results) * 10.0 * 86400.0
        u = rng.uniform(1.2, 1.9, results) if one_sided else rng.uniform(0.0, 2.0 * np.pi, results)
        self.cos_sin = np.column_stack([np.cos(u), np.sin(u)])
        phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        circle = np.stack([np.cos(phase), np.sin(phase)])
        self.annual, self.orbit = (np.zeros((2, 3)) for _ in range(2))
        self.annual[:, 0], self.orbit[:, 1] = annual * circle[:, 0], orbit * circle[:, 1]
        self.rows = (
            int(rng.integers(results // 6, results // 2)),
            int(rng.integers(5 * results // 9, 5 * results // 6)),
        )
        self.steps = np.array([[steps[0], 0.0, 0.0], [0.0, steps[1], 0.0]])

    def theta(self, t_s, cos_sin):
        """(N, 3), rad."""
        later = (t_s[:, None] >= self.t_s[list(self.rows)]).astype(float)
        return (annual_columns(t_s) @ self.annual + cos_sin @ self.orbit + later @ self.steps) * ARCSEC

    def series(self, pair, rng):
        """What results at all instants say, drawn from their information."""
        return DrawnMission(pair, rng).series(self.t_s, self.theta(self.t_s, self.cos_sin), self.cos_sin)
