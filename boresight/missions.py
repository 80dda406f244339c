"""The installation matrix from a dump: estimated, read back and validated."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from boresight.display import Result, axes_or_new
from boresight.geometry.constants import ARCSEC
from boresight.geometry.record import Floats, array, record, scalar
from boresight.pipeline.calibration_run import RunRequest, run_dump
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.results.reading import SavedResult
from boresight.pipeline.results.reading import read_result as saved_in
from boresight.pipeline.results.validate import Validation
from boresight.pipeline.results.validate import validate as against_truth
from boresight.pipeline.results.writing import write_result
from boresight.pipeline.run.settings import Settings, read_settings
from boresight.pipeline.run.workers import executor_for
from boresight.pipeline.stages.calibrate import Calibration as StageCalibration
from boresight.pipeline.stages.calibrate import calibrate_dump
from boresight.version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["Calibration", "calibrate", "read_result", "validate"]


@record(kw_only=True)
class Calibration(Result):
    """The installation matrix `R_cs` with its covariance.

    `R_cs = exp[[theta]] R_cs0`, a rotation by -theta about the axes of the remote-sensing camera's frame c
    (docs/conventions.md). `cov_theta` includes all errors that the mission states.
    """

    R_cs: Rotation = scalar("star-camera frame s to remote-sensing-camera frame c")
    theta: Floats = array("3", "deviation from the pre-launch matrix R_cs0, rad, axes of c")
    cov_theta: Floats = array("3, 3", "covariance of theta, rad², axes of c")
    counts: str = scalar("exposures, stars, strips and targets that the estimate uses")
    chi2: float | None = scalar(
        "squared residuals of targets over their variances; None from vectors", default=None
    )
    dof: int | None = scalar("its degrees of freedom", default=None)
    targets: pd.DataFrame = scalar(
        "one row a target sighting: residuals in arcsec about x and y of c, kept or not"
    )
    saved: SavedResult | None = scalar(
        "what the result folder holds; None from vectors", default=None, repr=False
    )
    folder: Path | None = scalar("the result folder, if there is one", default=None)
    _run: tuple[Dump, StageCalibration, Settings] | None = scalar(
        "of a run in memory", default=None, repr=False
    )

    __repr__ = Result.__repr__

    @property
    def sigma_arcsec(self) -> Floats:
        """(3,) 1-sigma about the axes of c, arcsec."""
        return np.sqrt(np.diag(self.cov_theta)) / ARCSEC

    @property
    def verdict(self) -> str:
        """`consistent` or `refuted`, by the statistics of the result itself; `not assessed` from vectors."""
        stated = None if self.saved is None else self.saved.installation.get("verdict")
        return str(stated["outcome"]) if isinstance(stated, dict) else "not assessed"

    def summary(self) -> str:
        theta, sigma = self.theta / ARCSEC, self.sigma_arcsec
        angles = ", ".join(f"{name} {t:+.3f} +- {s:.3f}" for name, t, s in zip("XYZ", theta, sigma))
        fit = (
            "from vectors"
            if self.chi2 is None
            else f"{self.verdict}, chi2 / dof {self.chi2:.1f} / {self.dof}"
        )
        return f"R_cs: theta {angles} arcsec\n{fit}\n{self.counts}"

    def table(self) -> pd.DataFrame:
        """One row an axis of c: theta_arcsec, sigma_arcsec, and the correlations with x, y, z."""
        sigma = np.sqrt(np.diag(self.cov_theta))
        correlation = self.cov_theta / np.outer(sigma, sigma)
        columns = {"axis": list("XYZ"), "theta_arcsec": self.theta / ARCSEC, "sigma_arcsec": sigma / ARCSEC}
        return pd.DataFrame(columns | {f"correlation_{name}": row for name, row in zip("xyz", correlation)})

    def plot(self, ax: Axes | None = None) -> Axes:
        """Residuals of the targets about the axes of c; from vectors, the 1-sigma of each axis as bars."""
        ax = axes_or_new(ax)
        if not len(self.targets):
            ax.bar(list("XYZ"), self.sigma_arcsec, color="0.6", edgecolor="black")
            ax.set_ylabel("1 sigma, arcsec")
            return ax
        for kept, marker in ((True, "o"), (False, "x")):
            rows = self.targets[self.targets["kept"] == kept]
            label = f"{len(rows)} {'kept' if kept else 'rejected'}"
            ax.plot(
                rows["residual_x_arcsec"], rows["residual_y_arcsec"], marker, fillstyle="none", label=label
            )
        ax.set(xlabel="residual along x of c, arcsec", ylabel="residual along y of c, arcsec", aspect="equal")
        ax.legend(title="targets")
        return ax

    def report(self, path: str | Path) -> Path:
        """Write the report, one HTML page that needs no network; the path written.

        Raises `ValueError` for a result from vectors, which has no images to show.
        """

        from boresight.pipeline.report.evidence import write_evidence  # with the page: Matplotlib, 0.3 s
        from boresight.pipeline.report.page import write_report

        if self.folder is None and self._run is None:
            raise ValueError("a report needs the result of a dump, this one is from vectors")
        with tempfile.TemporaryDirectory() as scratch:
            folder = self.folder or Path(scratch)
            if self._run is not None and self.folder is None:
                dump, found, settings = self._run
                write_evidence(folder, dump, found, settings)
                write_result(folder, found, settings)
            Path(path).write_bytes(write_report(folder).read_bytes())
        return Path(path)


def calibrate(
    dump: str | Path | Dump,
    *,
    out: str | Path | None = None,
    settings: str | Path | Settings | None = None,
    workers: int = 1,
    allow_stale_eop: bool = False,
) -> Calibration:
    """The installation matrix of a dump, from raw star images and raw strips.

    Parameters
    ----------
    dump : path or Dump
        Folder with a dump.toml (docs/dump-format.md), or what `open_dump` returned.
    out : path, optional
        Result folder, written as by `boresight calibrate` with its report; an interrupted run continues in
        it. Without it nothing stays on disk.
    settings : path or Settings, optional
        TOML file of settings, or the record; default: all defaults.
    workers : int
        Processes on this machine.
    allow_stale_eop : bool
        Continue with a warning past the end of the Earth-orientation table.

    Returns
    -------
    Calibration
        `R_cs`, `cov_theta`, `table()`, `plot()`, `report(path)`.

    Raises
    ------
    RawDataError
        If a file of the dump is missing or wrong; the message names file, field, found and expected.
    DataNotSufficientError
        If the data do not determine all three angles; the message says what is missing.

    Examples
    --------
    >>> import boresight as bs
    >>> est = bs.calibrate("fixtures/mini")
    >>> est.R_cs.as_matrix().round(6).tolist()[2]
    [0.152413, 0.205592, -0.966697]
    """
    chosen = _settings_of(settings)
    opened = open_dump(dump, allow_stale_eop=allow_stale_eop)
    with executor_for(workers, None, opened.pixels) as executor, tempfile.TemporaryDirectory() as scratch:
        if out is not None:
            facts = {"version": __version__, "workers": workers}
            request = RunRequest(settings=chosen, begun_s=time.perf_counter(), facts=facts)
            run_dump(Path(out), opened, str(opened.root), request, executor, lambda stage, done, total: None)
            return read_result(out)
        found = calibrate_dump(opened, chosen, None, executor)
        write_result(Path(scratch), found, chosen)
        return dataclasses.replace(read_result(scratch), folder=None, _run=(opened, found, chosen))


def _settings_of(settings: str | Path | Settings | None) -> Settings:
    """The settings themselves, or those of a file, or all defaults."""
    return settings if isinstance(settings, Settings) else read_settings(Path(settings) if settings else None)


def read_result(folder: str | Path) -> Calibration:
    """A finished result folder read back.

    Parameters
    ----------
    folder : path
        What `calibrate` or `boresight calibrate --out` wrote.

    Returns
    -------
    Calibration

    Raises
    ------
    RawDataError
        If the folder is not a finished result, or damaged.
    """
    saved = saved_in(Path(folder))
    facts = saved.installation
    targets = pd.read_parquet(Path(folder) / "sightings" / "targets.parquet")
    residual = np.array(targets["residual_c"].tolist(), dtype=float).reshape(-1, 2) / ARCSEC
    columns = targets[["strip_id", "target_id", "ccd", "correlation", "kept"]]
    columns = columns.assign(residual_x_arcsec=residual[:, 0], residual_y_arcsec=residual[:, 1])
    return Calibration(
        R_cs=saved.R_cs,
        theta=saved.theta,
        cov_theta=saved.cov_theta,
        chi2=facts["chi2"],
        dof=facts["dof"],
        counts=f"{facts['frames']} exposures, {facts['stars']} stars, {facts['targets']} target sightings",
        targets=columns,
        saved=saved,
        folder=Path(folder),
    )


def validate(result: Calibration | str | Path, dump: str | Path | Dump) -> Validation:
    """Errors of a result against the truth of the simulated dump that it was made from.

    Parameters
    ----------
    result : Calibration or path
        What `calibrate` returned, or its result folder.
    dump : path or Dump
        The dump, with its truth/ folder.

    Returns
    -------
    Validation
        `error_rad` (3,) about the axes of c, `sigma_rad` (3,), `nees` (3 is expected), and the positions of
        check points on the ground `before` and `after`, m.

    Raises
    ------
    RawDataError
        If the dump has no truth.
    ValueError
        If the result is from vectors.
    """
    estimate = result if isinstance(result, Calibration) else read_result(result)
    if estimate.saved is None:
        raise ValueError("validate needs the result of a dump, this one is from vectors")
    return against_truth(estimate.saved, open_dump(dump))
