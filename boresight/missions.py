"""The installation matrix from a dump or from vectors: estimated, read back, validated and applied."""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from boresight.display import Result, axes_or_new
from boresight.geometry.constants import ARCSEC
from boresight.geometry.record import Floats, Ints, array, record, scalar
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.dump import open_dump as dump_at
from boresight.pipeline.files.object_store import dump_folder
from boresight.version import __version__

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes

    from boresight.features.planning.campaign_plan import PlanForecast
    from boresight.pipeline.results.reading import SavedResult
    from boresight.pipeline.results.validate import Validation
    from boresight.pipeline.run.settings import Settings
    from boresight.pipeline.stages.calibrate import Calibration as StageCalibration

__all__ = [
    "Calibration",
    "calibrate",
    "calibrate_vectors",
    "forecast",
    "geolocate",
    "open_dump",
    "read_result",
    "simulate",
    "validate",
]

Vectors = Floats | Sequence[Floats]  # of one frame, or one array a frame
Sigmas = float | Floats | Sequence[float] | Sequence[Floats]


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
        import pandas as pd

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
        from boresight.pipeline.report.evidence import write_evidence
        from boresight.pipeline.report.page import write_report
        from boresight.pipeline.results.writing import write_result

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


def calibrate_vectors(
    u_s: Vectors,
    v_stars: Vectors,
    sigma_s: Sigmas,
    w_c: Vectors,
    v_targets: Vectors,
    sigma_c: Sigmas,
    R_cs0: Rotation,
) -> Calibration:
    """The installation matrix from star and target vectors of one frame or many; attitudes are not needed.

    A frame is one attitude. Errors are isotropic and independent from vector to vector; for strips with
    errors of orbit, clock, vibration and distortion use `calibrate`. All six arguments are arrays for one
    frame, or lists with one array a frame.

    Parameters
    ----------
    u_s : (N, 3) array, or list of them
        Measured unit vectors of stars, star-camera frame s.
    v_stars : (N, 3) array, or list of them
        Their apparent directions, GCRS.
    sigma_s : float, (N,) array, or list of them
        Their 1-sigma errors per axis, rad.
    w_c : (J, 3) array, or list of them
        Measured unit vectors of targets, remote-sensing-camera frame c.
    v_targets : (J, 3) array, or list of them
        Directions from the camera to the targets, GCRS.
    sigma_c : float, (J,) array, or list of them
        Their 1-sigma errors per axis, rad.
    R_cs0 : Rotation
        Approximate installation matrix, s to c.

    Returns
    -------
    Calibration
        `R_cs` and `cov_theta` (3, 3), rad², axes of c.

    Raises
    ------
    ValueError
        If shapes do not agree or the iteration does not converge.
    DataNotSufficientError
        If the vectors do not determine all three angles.

    Examples
    --------
    >>> import boresight as bs, numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> R_cs = Rotation.from_euler("xyz", [150, 10, 30], degrees=True)
    >>> stars = np.array([[0.1, 0.1, 1], [-0.1, 0.1, 1], [0.0, -0.1, 1]]); stars /= np.linalg.norm(stars[0])
    >>> ground = np.array([[0.01, 0, 1], [-0.01, 0.01, 1]]); ground /= np.linalg.norm(ground, axis=1)[:, None]
    >>> stars /= np.linalg.norm(stars, axis=1)[:, None]
    >>> est = bs.calibrate_vectors(stars, stars, 1e-6, ground, R_cs.inv().apply(ground), 1e-6, R_cs)
    >>> bool(est.sigma_arcsec[2] > est.sigma_arcsec[0])
    True
    """
    import pandas as pd

    from boresight.calib.frames import calibrate_frames
    from boresight.geometry.installation import theta_between
    from boresight.geometry.vector_sets import VectorSets

    stars, targets = _frames("u_s", u_s, v_stars, sigma_s), _frames("w_c", w_c, v_targets, sigma_c)
    vectors = VectorSets(
        star_start=stars[0],
        u_s=stars[1],
        v_stars=stars[2],
        sigma_s=stars[3],
        target_start=targets[0],
        w_c=targets[1],
        v_targets=targets[2],
        sigma_c=targets[3],
    )
    found = calibrate_frames(vectors, R_cs0)
    if len(found.solution.unobservable):
        raise DataNotSufficientError(
            f"rotations about {found.solution.unobservable} (frame c) are not observable"
        )
    frames, n_stars, n_targets = len(stars[0]) - 1, int(stars[0][-1]), int(targets[0][-1])
    return Calibration(
        R_cs=found.R_cs,
        theta=theta_between(found.R_cs, R_cs0),
        cov_theta=found.solution.covariance,
        counts=f"{frames} frames with {n_stars} star vectors and {n_targets} target vectors",
        targets=pd.DataFrame(),
    )


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
    from boresight.pipeline.calibration_run import RunRequest, run_dump
    from boresight.pipeline.results.writing import write_result
    from boresight.pipeline.run.workers import executor_for
    from boresight.pipeline.stages.calibrate import calibrate_dump

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
    from boresight.pipeline.run.settings import Settings, read_settings

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
    import pandas as pd

    from boresight.pipeline.results.reading import read_result as saved_in

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
    from boresight.pipeline.results.validate import validate as against_truth

    estimate = result if isinstance(result, Calibration) else read_result(result)
    if estimate.saved is None:
        raise ValueError("validate needs the result of a dump, this one is from vectors")
    return against_truth(estimate.saved, open_dump(dump))


def geolocate(
    result: str | Path,
    strip: str,
    ccd: ArrayLike,
    sample_px: ArrayLike,
    line_px: ArrayLike,
    *,
    dump: str | Path | None = None,
    height_m: float | None = None,
) -> pd.DataFrame:
    """Where on the ground pixels of a strip look, with 1-sigma along and across the track.

    Parameters
    ----------
    result : path
        A result folder.
    strip : str
        Id of the strip.
    ccd, sample_px, line_px : (N,) arrays or numbers
        CCD number from 0, and the image point; (0, 0) is the centre of the first pixel.
    dump : path, optional
        The dump; default: the one that the result names.
    height_m : float, optional
        Ellipsoidal height of the ground, m; default: the dump's terrain model.

    Returns
    -------
    pandas.DataFrame
        One row a pixel: lat_deg, lon_deg, height_m, sigma_along_m, sigma_across_m; NaN where the line of
        sight meets no known ground or the row has no attitude.

    Raises
    ------
    RawDataError
        If result or dump cannot be read or the strip is unknown.
    """
    import pandas as pd

    from boresight.features.geolocate.positions import Pixels
    from boresight.features.geolocate.positions import geolocate as positions_of
    from boresight.geometry.terrain import ConstantHeight
    from boresight.pipeline.files.dump import surface_of
    from boresight.pipeline.results.strip_model import open_calibrated, strip_model

    calibrated = open_calibrated(Path(result), None if dump is None else dump_folder(dump))
    numbers = np.broadcast_arrays(*(np.atleast_1d(np.asarray(part)) for part in (ccd, sample_px, line_px)))
    pixels = Pixels(numbers[0].astype(np.int64), numbers[1].astype(float), numbers[2].astype(float))
    surface = surface_of(calibrated.dump.terrain) if height_m is None else ConstantHeight(height_m)
    found = positions_of(calibrated, strip_model(calibrated, strip), pixels, surface)
    columns = ("lat_deg", "lon_deg", "height_m", "sigma_along_m", "sigma_across_m")
    return pd.DataFrame({name: getattr(found, name) for name in columns})


def open_dump(dump: str | Path | Dump, *, allow_stale_eop: bool = False) -> Dump:
    """A dump opened and checked: cameras, orbit, exposures, strips, targets; images are not decoded.

    Parameters
    ----------
    dump : path or Dump
        Folder with a dump.toml; an open dump is returned as it is.
    allow_stale_eop : bool
        Continue with a warning past the end of the Earth-orientation table.

    Returns
    -------
    Dump
        `star_camera`, `line_camera`, `orbit`, `exposures`, `strips`, `targets`, `R_cs0`, ...

    Raises
    ------
    RawDataError
        If a file is missing or wrong; the message names file, field, found and expected.

    Examples
    --------
    >>> import boresight as bs
    >>> dump = bs.open_dump("fixtures/mini")
    >>> len(dump.exposures), len(dump.strips), len(dump.targets)
    (42, 3, 36)
    """
    return dump if isinstance(dump, Dump) else dump_at(dump, allow_stale_eop=allow_stale_eop)


def simulate(scenario: str, out: str | Path, *, seed: int = 1, changes: Sequence[str] = ()) -> Path:
    """Render a mission with known truth as a dump.

    Parameters
    ----------
    scenario : str
        "mini", "paper", "sky", or the path of a TOML file (docs/simulator.md).
    out : path
        Folder to make; it must not exist or be empty.
    seed : int
        All random numbers come from it.
    changes : sequence of str
        Changed settings such as "strips.count=5".

    Returns
    -------
    Path
        The folder.

    Raises
    ------
    ValueError
        If the folder holds files, or the scenario or a change is not known.
    """
    from boresight.pipeline.files.dump_writer import write_dump
    from boresight.pipeline.files.scenario_file import fly, named_scenario
    from boresight.pipeline.files.whole_file import is_vacant

    folder = Path(out)
    if not is_vacant(folder):
        raise ValueError(f"{folder} exists and is not an empty folder")
    made_by = f"boresight {__version__}: simulate {scenario} --seed {seed}"
    write_dump(fly(named_scenario(scenario, changes), seed), folder, created_by=made_by)
    return folder


def forecast(plan: str | Path, *, target_arcsec: float | None = None) -> PlanForecast:
    """Expected 1-sigma of the installation matrix for a planned campaign, before any data.

    Parameters
    ----------
    plan : path
        TOML file that describes cameras, strips, targets and errors, as for `boresight plan`.
    target_arcsec : float, optional
        Wanted 1-sigma on every axis, arcsec: the number of strips that reach it is returned, too.

    Returns
    -------
    PlanForecast
        `table`: 1-sigma about each axis against the number of strips, arcsec; `strips_needed`.

    Raises
    ------
    RawDataError
        If the file has unknown or wrong entries.
    DataNotSufficientError
        If the campaign cannot be forecast.
    """
    from boresight.features.planning.campaign_plan import forecast_plan, read_plan

    return forecast_plan(read_plan(Path(plan)), target_arcsec)


def _frames(
    name: str, vectors: Vectors, known: Vectors, sigma: Sigmas
) -> tuple[Ints, Floats, Floats, Floats]:
    """Start of each frame (K + 1,), and its vectors, known directions and sigmas, one after another."""
    one = isinstance(vectors, np.ndarray) and vectors.ndim == 2
    parts = [np.asarray(v, dtype=float) for v in ([vectors] if one else vectors)]
    directions = [np.asarray(v, dtype=float) for v in ([known] if one else known)]
    sigmas = [sigma] * len(parts) if one or isinstance(sigma, float | int) else list(sigma)
    shapes = [part.shape for part in parts]
    if shapes != [part.shape for part in directions] or any(shape[1:] != (3,) for shape in shapes):
        found = f"{shapes}, {[part.shape for part in directions]}"
        raise ValueError(f"{name} and its known directions must be (N, 3) in each frame, got {found}")
    if len(sigmas) != len(parts):
        raise ValueError(f"sigma of {name}: {len(sigmas)} given for {len(parts)} frames")
    start = np.cumsum([0, *(len(part) for part in parts)])
    errors = [np.broadcast_to(np.asarray(s, dtype=float), len(part)) for s, part in zip(sigmas, parts)]
    return start.astype(np.int64), np.vstack(parts), np.vstack(directions), np.concatenate(errors)
