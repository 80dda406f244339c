"""Whether the matrices of two results differ by more than their errors, and what else differs between them.

Each result is x = N⁻¹ b with the unknowns x = (theta, distortion of the camera) and N = F + P, P the prior
information. What both results share has the same errors in both: strips that are in both, of information F_c,
and the camera's distortion, of prior P. So

    cov(x_A, x_B) = N_A⁻¹ (F_c + P) N_B⁻¹,    cov(x_B - x_A) = N_A⁻¹ + N_B⁻¹ - cov(x_A, x_B) - cov(x_B, x_A)

Targets that both results see at other times count as surveyed independently for each.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from scipy.special import chdtrc

from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs
from boresight.display import Result, axes_or_new
from boresight.features.mission.saved_mounting import ORIGIN, SavedMounting
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.pipeline import __version__
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.text_tables import leaves
from boresight.pipeline.report.page_template import template
from boresight.pipeline.results.reading import read_mounting
from boresight.records.record import Floats, array, record, scalar

__all__ = ["Comparison", "Differing", "compare_mountings"]

# Share of a direction's variance that is left in the difference; below it both results have the same
# observations, and their difference is no matter of chance.
LEAST_OWN = 1e-6
SAME_INSTANT_S = 1e-3  # strips whose middles are nearer are one
# Facts about a result that two may differ in, in the order of the table.
STATED = ("mission", "satellite", "camera", "head", "star_camera", "model", "verdict")


@record
class Differing:
    """Something that is not the same in both results."""

    what: str = scalar("input, setting or version")
    first: str = scalar("in the first; empty: not there")
    second: str = scalar("in the second; empty: not there")


@record(kw_only=True)
class Comparison(Result):
    """The matrix of a second result against that of a first: R_second = exp[[theta]] R_first."""

    first: SavedMounting = scalar("the first result", repr=False)
    second: SavedMounting = scalar("the second result", repr=False)
    theta_c: Floats = array("3", "difference, frame c, rad")
    covariance_c: Floats = array("3, 3", "its covariance, shared errors cancelled, rad²")
    theta_s: Floats = array("3", "the same rotation, frame s, rad")
    covariance_s: Floats = array("3, 3", "its covariance, frame s, rad²")
    chi2: float = scalar("difference squared over its covariance")
    dof: int = scalar("directions in which the results have observations of their own")
    common_strips: tuple[str, ...] = scalar("strips of the second result that are in the first, too")
    shares_camera: bool = scalar("both have one camera model, whose distortion is one unknown")
    false_alarm: float = scalar("p-value below which the matrices differ")
    differing: tuple[Differing, ...] = scalar("what is not the same: inputs, settings, versions", repr=False)

    @property
    def p_value(self) -> float:
        """Probability of a difference as large, if the mounting is the same; 1 where nothing is random."""
        return float(chdtrc(self.dof, self.chi2)) if self.dof else 1.0

    @property
    def differs(self) -> bool:
        """Whether the difference is beyond its errors."""
        return self.p_value < self.false_alarm

    @property
    def ground_m(self) -> Floats:
        """(3,) effect on the ground about X, Y (at the axis) and Z (at the swath's edge), m."""
        return np.abs(self.theta_c) * self.second.ground_m_per_rad

    @property
    def verdict(self) -> str:
        """The answer in a sentence."""
        if not self.dof:
            return "both results have the same observations: their difference is not one of chance, no test"
        said = "the matrices differ" if self.differs else "no sign that the matrices differ"
        return f"{said}: chi2 / dof {self.chi2:.2f} / {self.dof}, p {self.p_value:.3g}"

    def summary(self) -> str:
        """Difference in both frames with 1-sigma errors, the test, and what else is different."""
        lines = [
            f"{self.first.id} of {self.first.utc[:10]} and {self.second.id} of {self.second.utc[:10]}",
            f"{'':26s}{'X':>14s}{'Y':>14s}{'Z':>14s}",
        ]
        lines += [
            f"{name:27s}" + "".join(f"{value:+14.4f}" for value in values) for name, values in self.rows
        ]
        lines += [f"shared, so not independent: {self.shared_words}", self.verdict]
        return "\n".join([*lines, f"{len(self.differing)} inputs, settings or versions differ"])

    @property
    def rows(self) -> list[tuple[str, Floats]]:
        """Difference (3,) in both frames with 1-sigma errors, and on the ground, about X, Y, Z."""
        sigma_c, sigma_s = (np.sqrt(np.diag(C)) / ARCSEC for C in (self.covariance_c, self.covariance_s))
        return [
            ("difference, frame c, arcsec", self.theta_c / ARCSEC),
            ("1 sigma", sigma_c),
            ("on the ground, m", self.ground_m),
            ("difference, frame s, arcsec", self.theta_s / ARCSEC),
            ("1 sigma", sigma_s),
        ]

    @property
    def shared_words(self) -> str:
        """What both results share."""
        shared = [f"{len(self.common_strips)} strips"] if self.common_strips else []
        shared += ["the camera's distortion"] if self.shares_camera and self.first.pair.shared else []
        return " and ".join(shared) or "nothing"

    def table(self) -> pd.DataFrame:
        """One row something that is not the same in both results."""
        rows = [(one.what, one.first, one.second) for one in self.differing]
        return pd.DataFrame(rows, columns=["what", "first", "second"])

    def content(self) -> dict[str, Any]:
        """For programs."""
        return {
            "first": self.first.id,
            "second": self.second.id,
            "theta_c_rad": self.theta_c.tolist(),
            "covariance_c_rad2": self.covariance_c.tolist(),
            "theta_s_rad": self.theta_s.tolist(),
            "covariance_s_rad2": self.covariance_s.tolist(),
            "ground_m": self.ground_m.tolist(),
            "chi2": self.chi2,
            "dof": self.dof,
            "p_value": self.p_value,
            "differs": self.differs,
            "common_strips": list(self.common_strips),
            "shares_camera": self.shares_camera,
            "differing": [[one.what, one.first, one.second] for one in self.differing],
        }

    def card(self) -> str:
        """One HTML page that needs no network."""
        return template("compare.html.j2").render(
            first=f"{self.first.id} of {self.first.utc[:10]}",
            second=f"{self.second.id} of {self.second.utc[:10]}",
            differs=self.differs,
            tested=self.dof > 0,
            sentence=self.verdict,
            rows=[(name, [f"{value:+.4f}" for value in values]) for name, values in self.rows],
            shared=f"Shared by both, so not independent: {self.shared_words}.",
            differing=self.differing,
            version=__version__,
        )

    def plot(self, ax: Axes | None = None) -> Axes:
        """The difference about each axis of c with its 1-sigma."""
        ax = axes_or_new(ax)
        sigma = np.sqrt(np.diag(self.covariance_c)) / ARCSEC
        ax.errorbar(["X", "Y", "Z"], self.theta_c / ARCSEC, yerr=sigma, fmt="o")
        ax.axhline(0.0, lw=0.8)
        ax.set_ylabel("difference, arcsec, 1 sigma")
        return ax


def compare_mountings(first: SavedMounting, second: SavedMounting, false_alarm: float = 0.01) -> Comparison:
    """The second result against the first."""
    t = [ORIGIN.seconds_from_utc(one.strips_utc.tolist()) for one in (first, second)]
    same_instant = (np.abs(t[1][:, None] - t[0]) < SAME_INSTANT_S).any(axis=1)
    common = [str(name) for name in second.strips[same_instant]]
    shares_camera = first.model == second.model
    theta = theta_between(second.R_cs, first.R_cs)
    covariance = _difference_covariance(first, second, common, shares_camera)
    scale = np.sqrt(np.diag(first.covariance + second.covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    own = values > LEAST_OWN
    along = (vectors.T @ (theta / scale))[own]
    R_sc = second.R_cs.inv().as_matrix()
    return Comparison(
        first=first,
        second=second,
        theta_c=theta,
        covariance_c=covariance,
        theta_s=R_sc @ theta,
        covariance_s=R_sc @ covariance @ R_sc.T,
        chi2=float(np.sum(along**2 / values[own])),
        dof=int(own.sum()),
        common_strips=tuple(common),
        shares_camera=shares_camera,
        false_alarm=false_alarm,
        differing=tuple(_differing(first, second)),
    )


def _difference_covariance(
    first: SavedMounting, second: SavedMounting, common: list[str], shares_camera: bool
) -> Floats:
    """Covariance (3, 3) of theta_second - theta_first."""
    shared = tuple(sorted(set(first.pair.shared) | set(second.pair.shared)))
    P = np.zeros((3 + len(shared), 3 + len(shared)))
    P[3:, 3:] = prior_information(shared)
    N = [np.linalg.inv(one.pair.widened(shared).F[0] + P) for one in (first, second)]
    both = P if shares_camera else np.zeros_like(P)
    if common:
        both = both + _of_strips(second, common).widened(shared).F[0]
    cross = (N[0] @ both @ N[1])[:3, :3]
    covariance = N[0][:3, :3] + N[1][:3, :3] - cross - cross.T
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _of_strips(saved: SavedMounting, strips: list[str]) -> InformationPairs:
    """The information of some strips of a result."""
    scale = dict.fromkeys(saved.strips.tolist(), 0.0) | dict.fromkeys(strips, 1.0)
    return read_mounting(saved.folder, saved.id, scale, saved.of_several)


def _differing(first: SavedMounting, second: SavedMounting) -> Iterator[Differing]:
    for name in STATED:
        if getattr(first, name) != getattr(second, name):
            yield Differing(name, str(getattr(first, name)), str(getattr(second, name)))
    ours, theirs = (
        {key: value for key, value in leaves(one.facts) if value != {}} | _inputs(one.folder)
        for one in (first, second)
    )
    for key in dict.fromkeys([*ours, *theirs]):
        if ours.get(key) != theirs.get(key):
            yield Differing(key, str(ours.get(key, "")), str(theirs.get(key, "")))


def _inputs(folder: Path) -> dict[str, str]:
    """Input files of a result with the begin of their SHA-256; empty where it was made without report."""
    path = folder / "evidence" / "inputs.parquet"
    try:
        rows = read_parquet(path).to_pylist() if path.is_file() else []
    except RawDataError:
        rows = []
    return {f"input {row['file']}": str(row["sha256"])[:16] for row in rows}
