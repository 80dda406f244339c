"""The installation matrix from a dump: estimated, read back, exported and validated."""

from __future__ import annotations

import dataclasses
import os
import re
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from boresight import accepted
from boresight.accepted import PathLike, Progress, no_progress
from boresight.calib.verdict import p_residuals
from boresight.display import Result, axes_or_new, feature_function
from boresight.features.table import features
from boresight.geometry.constants import ARCSEC
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.pipeline.calibration.calibrate import DumpCalibration as StageCalibration
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.calibration_run import RunRequest, run_dump, run_dumps
from boresight.pipeline.console.feature import hooks_of
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump, open_cameras, open_dump
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.text_files import read_json
from boresight.pipeline.report.evidence import write_evidence
from boresight.pipeline.report.notebook import calibration_html
from boresight.pipeline.report.page import write_report
from boresight.pipeline.results.check_point_test import RmsTest
from boresight.pipeline.results.folder import ScratchFolder, dumps_in
from boresight.pipeline.results.ownership import dump_identity
from boresight.pipeline.results.reading import SavedResult, read_for_dump, read_matrices, read_saved_result
from boresight.pipeline.results.sightings_tables import read_sightings
from boresight.pipeline.results.summary import validation_summary
from boresight.pipeline.results.validate import CheckPoints, TruthErrors
from boresight.pipeline.results.validate import validation_of as against_truth
from boresight.pipeline.results.writing import write_result, write_run
from boresight.pipeline.run.executor import executor_for
from boresight.pipeline.run.settings import Settings, read_settings
from boresight.pipeline.run.several_dumps import named_cameras, open_dumps
from boresight.records.record import Floats, array, inner, record, scalar
from boresight.version import __version__

if TYPE_CHECKING:
    from geopandas import GeoDataFrame
    from matplotlib.axes import Axes

__all__ = ["UNUSED", "Calibration", "Validation", "calibrate", "read_result", "validate"]

DumpLike = PathLike | Dump
UNUSED = ["kind", "name", "reason", "cause", "file"]  # columns of what is not used
# Columns of sightings/stars.parquet and of sightings/targets.parquet, with the names that tables of a result
# give them.
STARS = {"exposure_id": "exposure", "hip": "hip", "normalised": "statistic", "kept": "kept"}
TARGETS = {"strip_id": "strip_id", "target_id": "target_id", "ccd": "ccd", "correlation": "correlation"}


@record(kw_only=True)
class Calibration(Result):
    """The installation matrix `R_cs` with its covariance; of C cameras of one satellite C matrices, T = 3 C.

    `R_cs = exp[[theta]] R_cs0`, a rotation by -theta about the axes of the remote-sensing camera's frame c
    (docs/conventions.md). `cov_theta` includes all errors that the mission states. A calibration is
    `os.PathLike`, the path of its result folder: functions that take that folder take the calibration, too.
    """

    R_cs: Rotation = scalar("star-camera frame s to remote-sensing-camera frame c; (C,) of several cameras")
    theta: Floats = array("T", "deviation from the pre-launch matrix R_cs0, rad, axes of c")
    cov_theta: Floats = array("T, T", "covariance of theta, rad², axes of c")
    counts: str = scalar("exposures, stars, strips and targets that the estimate uses")
    chi2: float = scalar("squared residuals of targets over their variances")
    dof: int = scalar("its degrees of freedom")
    targets: pd.DataFrame = scalar(
        "one row a target sighting: residuals in arcsec along x and y of c, statistic, p_value, kept"
    )
    not_used: pd.DataFrame = scalar("one row an item that the estimate does not use: kind, name, reason")
    facts: Mapping[str, Any] = scalar("verdict and blind spots as installation.json has them", repr=False)
    stars: pd.DataFrame | None = scalar(
        "of vectors: one row a star; of dumps `residuals('stars')` reads them", default=None, repr=False
    )
    saved: SavedResult | None = scalar(
        "what the result folder holds; None from vectors", default=None, repr=False
    )
    cameras: tuple[str, ...] = array("C", "names of the cameras; a single one has none", default=("",))
    folder: Path | None = scalar("the result folder, if one was given", default=None)
    _scratch: ScratchFolder | None = scalar("files of a result without folder", default=None, repr=False)
    _run: tuple[Dump, StageCalibration, Settings] | None = scalar(
        "of a run in memory", default=None, repr=False
    )

    def __fspath__(self) -> str:
        """The result folder."""
        if self._scratch is None and self.folder is None:
            raise ValueError("this result has no folder")
        return os.fspath(self.folder or self._scratch.path)  # type: ignore[union-attr]

    @property
    def sigma_arcsec(self) -> Floats:
        """(T,) 1-sigma about the axes of c, arcsec."""
        return np.sqrt(np.diag(self.cov_theta)) / ARCSEC

    @property
    def verdict(self) -> str:
        """`consistent`, `consistent, findings`, `not checkable` or `refuted`, by the statistics of the result
        itself.
        """
        return str(self._stated.get("outcome", "not assessed"))

    @property
    def p_value(self) -> float:
        """Probability of a chi2 as large or as small, if errors are as stated: `p_plain` of "residuals of
        targets" in `checks`; NaN without degrees of freedom.
        """
        return p_residuals(self.chi2, self.dof)

    @property
    def checks(self) -> pd.DataFrame:
        """One row a test of the verdict: kind, statistic, expected, n, p_plain, p_value, limit, holds, fails;
        neither holds nor fails what is not applicable.
        """
        names = ["kind", "statistic", "expected", "n", "p_plain", "p_value", "limit", "holds", "fails"]
        return pd.DataFrame(list(self._stated.get("checks") or []), columns=names)

    @property
    def findings(self) -> pd.DataFrame:
        """One row an input that looks wrong: cause, item, text, refutes, effect_sigma."""
        names = ["cause", "item", "text", "refutes", "effect_sigma"]
        return pd.DataFrame(list(self._stated.get("findings") or []), columns=names)

    @property
    def blind_spots(self) -> pd.DataFrame:
        """One row an error of an input that the data cannot show, or only after it has moved theta by more
        than 2 sigma: cause, item, unit, effect of one unit about x, y, z of c in arcsec, hidden_sigma.
        """
        rows = [
            {name: one.get(name) for name in ("cause", "item", "unit", "is_unseen", "hidden_sigma")}
            | {f"effect_{axis}_arcsec": e / ARCSEC for axis, e in zip("xyz", one.get("effect_rad") or [])}
            for one in self.facts.get("blind_spots") or []
        ]
        effects = [f"effect_{axis}_arcsec" for axis in "xyz"]
        return pd.DataFrame(rows, columns=["cause", "item", "unit", *effects, "is_unseen", "hidden_sigma"])

    @property
    def _stated(self) -> Mapping[str, Any]:
        stated = self.facts.get("verdict")
        return stated if isinstance(stated, dict) else {}

    def residuals(self, of: Literal["targets", "stars"] = "targets") -> pd.DataFrame:
        """Residuals, one row an observation, in arcsec, with statistic (chi-square of 2 degrees of freedom),
        p_value and kept: of targets along x and y of frame c, of stars along x and y of frame s.
        """
        if of not in ("targets", "stars"):
            raise accepted.wrong("of", of, "'targets' or 'stars'")
        if of == "targets":
            return self.targets
        return self.stars if self.stars is not None else _star_residuals(Path(self))

    def summary(self) -> str:
        """Matrix, fit, counts, the verdict's sentence, what is not used: few lines, as `print` shows them."""
        every = zip("XYZ" * len(self.cameras), self.theta / ARCSEC, self.sigma_arcsec)
        numbers = [f"{name} {t:+.3f} +- {s:.3f}" for name, t, s in every]
        angles = [
            f"R_cs{' of ' * bool(camera)}{camera}: theta {', '.join(numbers[n : n + 3])} arcsec"
            for n, camera in zip(range(0, len(numbers), 3), self.cameras)
        ]
        sentence = self._stated.get("sentence") or self.verdict
        fit = f"{sentence}\nchi2 / dof {self.chi2:.1f} / {self.dof} (p {self.p_value:.2g})"
        return "\n".join([*angles, fit, f"from {self.counts}", self._not_used_line()])

    def _repr_html_(self) -> str:
        rows = [
            (f"R_cs, row {'XYZ'[n % 3]}", "+.9f", row)
            for n, row in enumerate(self.R_cs.as_matrix().reshape(-1, 3))
        ]
        for name, values in (("theta, arcsec", self.theta / ARCSEC), ("1 sigma, arcsec", self.sigma_arcsec)):
            rows += [(name, ".4f", values[n : n + 3]) for n in range(0, len(values), 3)]
        at, kept = self._places(), self.targets["kept"].to_numpy()
        known = at.notna().all(axis=1).to_numpy()
        sentence = self._stated.get("sentence") or self.verdict
        return calibration_html(self.verdict, sentence, rows, at.to_numpy()[known], kept[known])

    def geodataframe(self) -> GeoDataFrame:
        """`targets` as points, EPSG:4326; needs geopandas. Raises `ValueError` where no place of a target is
        known: of given directions, and of a folder without evidence.
        """
        from geopandas import GeoDataFrame, points_from_xy  # no other function loads it

        at = self._places()
        if at.isna().all(axis=None):
            raise ValueError("geodataframe: no place of a target is known")
        return GeoDataFrame(self.targets, geometry=points_from_xy(at["lon_deg"], at["lat_deg"]), crs=4326)

    def _places(self) -> pd.DataFrame:
        """Columns lon_deg and lat_deg of each row of `targets`; NaN where they are not known."""
        columns, rows = ["lon_deg", "lat_deg"], self.targets
        unknown = pd.DataFrame(np.nan, index=rows.index, columns=columns)
        if set(columns) <= set(rows.columns):  # places that were given with vectors
            return rows[columns]
        if self._run is not None:
            of = self._run[0].ground_targets
            p_e = [of[name].p_e if name in of else np.full(3, np.nan) for name in rows["target_id"]]
            lat, lon, height_m = geodetic_from_ecef(np.reshape(p_e, (-1, 3)))
            at = pd.DataFrame(np.degrees(np.column_stack([lon, lat])), rows.index, columns)
            return at[np.isfinite(height_m)].reindex(rows.index)
        keys, known = ["strip_id", "target_id", "ccd"], []
        for place in () if self.folder is None else (".", *dumps_in(self.folder)):
            if (path := Path(self) / place / "evidence" / "ground.parquet").is_file():
                ground = read_parquet(path).to_pandas()[[*keys, *columns]]
                known.append(
                    ground if place == "." else ground.assign(strip_id=f"{place}/" + ground["strip_id"])
                )
        if not known:
            return unknown
        at = pd.concat(known).drop_duplicates(keys).set_index(keys)
        return at.reindex(pd.MultiIndex.from_frame(rows[keys])).set_index(rows.index)

    def _not_used_line(self) -> str:
        groups = Counter(zip(self.not_used["kind"].tolist(), self.not_used["cause"].tolist()))
        parts = [f"{n} {kind}{'s' if n > 1 else ''} ({cause})" for (kind, cause), n in groups.most_common()]
        more = f" and {len(parts) - 6} kinds more" if len(parts) > 6 else ""
        return f"not used: {', '.join(parts[:6]) or 'nothing'}{more}"

    def table(self) -> pd.DataFrame:
        """One row an axis of c: theta_arcsec, sigma_arcsec, and the correlations with x, y, z."""
        sigma = np.sqrt(np.diag(self.cov_theta))
        correlation = self.cov_theta / np.outer(sigma, sigma)
        axes = [(camera, axis) for camera in self.cameras for axis in "XYZ"]
        named = {"camera": [camera for camera, _ in axes]} if len(self.cameras) > 1 else {}
        columns = {"axis": [axis for _, axis in axes], "theta_arcsec": self.theta / ARCSEC}
        columns |= {"sigma_arcsec": sigma / ARCSEC}
        of = [f"correlation_{f'{camera}_' * bool(camera)}{axis.lower()}" for camera, axis in axes]
        return pd.DataFrame(named | columns | dict(zip(of, correlation)))

    def of_camera(self, name: str) -> Calibration:
        """The matrix of one of several cameras, with its residuals; of all others what is common."""
        if name not in self.cameras:
            raise accepted.wrong("name", name, f"one of {', '.join(map(repr, self.cameras))}")
        if len(self.cameras) == 1:
            return self
        n = self.cameras.index(name)
        own = slice(3 * n, 3 * n + 3)
        camera_of = self.targets["strip_id"].str.rpartition("/")[0]
        return dataclasses.replace(
            self,
            R_cs=self.R_cs[n],
            theta=self.theta[own],
            cov_theta=self.cov_theta[own, own],
            cameras=(name,),
            targets=self.targets[(camera_of == name) | camera_of.str.endswith(f"-{name}")],
        )

    @property
    def between_cameras(self) -> pd.DataFrame:
        """One row a pair of cameras: a, b, rotation of frame b to frame a less that before launch about x, y,
        z of a with its 1-sigma, arcsec, and the p_value of its being the same.
        """
        rows = [
            dict(zip("ab", one["cameras"]))
            | {f"theta_{axis}_arcsec": value / ARCSEC for axis, value in zip("xyz", one["theta_rad"])}
            | {
                f"sigma_{axis}_arcsec": one["covariance_rad2"][n][n] ** 0.5 / ARCSEC
                for n, axis in enumerate("xyz")
            }
            | {"p_value": one["p_value"]}
            for one in self.facts.get("between_cameras") or []
        ]
        numbers = [f"{what}_{axis}_arcsec" for what in ("theta", "sigma") for axis in "xyz"]
        return pd.DataFrame(rows, columns=["a", "b", *numbers, "p_value"])

    def save(self, folder: PathLike) -> Path:
        """Write the result into a folder, new or empty, which `read_result` reads; the folder."""
        place = accepted.vacant_folder_of(folder, "folder")
        without = shutil.ignore_patterns(".boresight-lock")
        return Path(shutil.copytree(Path(self), place, ignore=without, dirs_exist_ok=True))

    def plot(self, ax: Axes | None = None) -> Axes:
        """Residuals of the targets along x and y of c."""
        ax = axes_or_new(ax)
        for kept, marker in ((True, "o"), (False, "x")):
            rows = self.targets[self.targets["kept"] == kept]
            label = f"{len(rows)} {'kept' if kept else 'rejected'}"
            ax.plot(
                rows["residual_x_arcsec"], rows["residual_y_arcsec"], marker, fillstyle="none", label=label
            )
        ax.set(xlabel="residual along x of c, arcsec", ylabel="residual along y of c, arcsec", aspect="equal")
        ax.legend(title="targets")
        return ax

    def report(self, path: PathLike) -> Path:
        """Write the report, one HTML page that needs no network; the path written.

        A result from vectors has no images to show. Raises `ValueError` for a joint result without a folder.
        """
        page, folder = accepted.new_file_of(path, "path"), Path(self)
        if self.facts.get("made_from") == "vectors":
            write: Callable[..., None] = feature_function("vectors", "write_vector_page")
            write(folder, page, self)
            return page
        if self.folder is None and self._run is None:
            raise ValueError("path: found a joint result without a folder, expected one made with out=FOLDER")
        if self._run is not None:
            dump, found, settings = self._run
            write_evidence(folder, dump, found, settings)
        page.write_bytes(write_report(folder).read_bytes())
        return page

    def export(
        self,
        formats: str | Sequence[str],
        out: PathLike,
        *,
        dump: DumpLike | None = None,
        strips: str | Sequence[str] = (),
        camera: str = "",
    ) -> list[Path]:
        """Write the result in formats that other tools read; the files written.

        Parameters
        ----------
        formats : str, or sequence of str
            `spice`, `spice-ck`, `aem`, `acm`, `operator`, `csm-isd`, `rpc`, `vrt`, `kml`, `asp`, `geojson`,
            `envi`, `qgis` or `fits` (docs/exports.md).
        out : path
            Folder for the files; it is made.
        dump : path or Dump, optional
            The dump; default: the one that the result was made from.
        strips : sequence of str, optional
            Ids of the strips wanted; default: all.
        camera : str
            Which of several cameras.

        Raises `ValueError` for an unknown format, and for all but `spice` of a result from vectors,
        `RawDataError` for a damaged result, `DataNotSufficientError` where a format has nothing to write.
        """
        write: Callable[..., list[Path]] = feature_function("exports", "export_files")
        place = None if dump is None else _folder_of(dump)
        return write(Path(self), formats, out, dump=place, strips=strips, camera=camera)

    def geolocate(
        self,
        strip: str,
        ccd: ArrayLike,
        line: ArrayLike,
        sample: ArrayLike,
        *,
        dump: DumpLike | None = None,
        camera: str = "",
        height_m: float | None = None,
    ) -> pd.DataFrame:
        """Where on the ground pixels (line, sample) of a strip look, as `boresight.geolocate`."""
        if self.facts.get("made_from") == "vectors":
            raise ValueError("geolocate: found a result from vectors, expected that of a dump, with strips")
        find: Callable[..., pd.DataFrame] = feature_function("geolocate", "geolocate")
        place = None if dump is None else _folder_of(dump)
        return find(self, strip, ccd, line, sample, dump=place, camera=camera, height_m=height_m)


@record(kw_only=True)
class Validation(Result):
    """Errors of a result, and of the matrix that it started from, against a simulated truth."""

    errors: TruthErrors = scalar("the full record")
    error_rad = inner[Floats](
        "errors.error_rad", "(3,) theta of the result's error: R_result = exp[[error]] R_true"
    )
    sigma_rad = inner[Floats]("errors.sigma_rad", "(3,) 1-sigma that the result states")
    nees = inner[float]("errors.nees", "error_rad squared in the stated covariance: chi-square of 3 dof")
    before_rad = inner[Floats]("errors.before_rad", "(3,) error of the pre-launch matrix")
    after = inner[CheckPoints]("errors.after", "check points with the result's matrix")
    before = inner[CheckPoints]("errors.before", "check points with the pre-launch matrix")
    predicted = inner[tuple[RmsTest, ...]](
        "errors.predicted", "errors of check points against those that the result predicts"
    )
    without = inner[int](
        "errors.without", "check points without attitude or ground, for which no error can be given"
    )

    def summary(self) -> str:
        """Errors per axis and on the ground, before and after."""
        return validation_summary(self.errors)

    def table(self) -> pd.DataFrame:
        """One row a check point: strip_id, point_id, lat_deg, lon_deg, errors after and before in m."""
        after = self.after
        columns = {name: getattr(after, name) for name in ("strip_id", "point_id", "lat_deg", "lon_deg")}
        for name, points in (("", after), ("before_", self.before)):
            for axis in ("along", "across", "up"):
                columns[f"{name}{axis}_m"] = getattr(points, f"{axis}_m")
        return pd.DataFrame(columns)

    def plot(self, ax: Axes | None = None) -> Axes:
        """Errors of the check points on the ground, with the result's matrix."""
        ax = axes_or_new(ax)
        ax.plot(self.after.across_m, self.after.along_m, "o", fillstyle="none")
        ax.set(xlabel="error across the track, m", ylabel="error along the track, m", aspect="equal")
        ax.grid(color="0.9")
        return ax


def calibrate(
    dump: DumpLike | Sequence[DumpLike],
    *,
    out: PathLike | None = None,
    settings: PathLike | Settings | None = None,
    strips: str | Sequence[str] | None = None,
    workers: int = 1,
    allow_stale_eop: bool = False,
    overwrite: bool = False,
    progress: Progress = no_progress,
) -> Calibration:
    """The installation matrix of a dump, from raw star images and raw strips; of several dumps, jointly.

    Parameters
    ----------
    dump : path or Dump, or sequence of them
        Folder with a dump.toml (docs/dump-format.md), its address in a store, or what `open_dump` returned.
        Several dumps of one mission give one matrix; with `out` each has its own result in a folder there.
    out : path, optional
        Result folder, written as by `boresight calibrate` with its report; an interrupted run continues in
        it. Without it nothing stays on disk once the result is no longer used.
    settings : path or Settings, optional
        TOML file of settings, or the record; default: all defaults.
    strips : sequence of str, optional
        Ids of the strips to use, of one dump; default: all.
    workers : int
        Processes on this machine, at least 1.
    allow_stale_eop : bool
        Continue with a warning past the end of the Earth-orientation table.
    overwrite : bool
        Replace the result of another dump or of other settings in `out`.
    progress : callable, optional
        Called with the stage, the tasks done and all tasks; default: a bar in a notebook, else nothing.

    Returns
    -------
    Calibration
        Of several cameras a matrix each, `of_camera(name)` and `between_cameras`; else
        `R_cs`, `cov_theta`, `verdict`, `table()`, `residuals()`, `plot()`, `report(path)`, `export(...)`.

    Raises
    ------
    RawDataError
        If a file of the dump is missing or wrong; the message names file, field, found and expected.
    DataNotSufficientError
        If the data do not determine all three angles; the message says what is missing.
    ValueError
        If an argument is not as described.
    WorkerError
        If a process died repeatedly, or an object store does not answer.

    Examples
    --------
    >>> import boresight as bs
    >>> est = bs.calibrate(bs.example("mini"))
    >>> est.verdict, bool(est.sigma_arcsec.max() < 10.0)
    ('consistent', True)
    """
    folder = None if out is None else accepted.new_folder_of(out, "out")
    told = accepted.progress_of(progress)
    n_workers, chosen = accepted.count_of(workers, "workers", 1, MOST_WORKERS), _settings_of(settings)
    given = [dump] if isinstance(dump, str | os.PathLike | Dump) else accepted.listed(dump, "dump", "dumps")
    sources = [source_of_dump(one) for one in given]
    if not sources:
        raise accepted.wrong("dump", "no dumps", "at least one")
    with _in_words_of_python():
        request = RunRequest(
            settings=chosen,
            begun_s=time.perf_counter(),
            overwrite=accepted.flag_of(overwrite, "overwrite"),
            facts={"version": __version__, "workers": n_workers},
            report=folder is not None,
            progress=told,
            after_joint=hooks_of(features(), "after_joint") if len(sources) > 1 else (),
        )
        stale = accepted.flag_of(allow_stale_eop, "allow_stale_eop")
        if len(sources) > 1:
            several = open_dumps([_folder_of(one) for one in sources], chosen, allow_stale_eop=stale)
        else:
            several = tuple(named_cameras(open_cameras(sources[0], allow_stale_eop=stale)))
        scratch = ScratchFolder()
        if len(several) > 1:
            if strips is not None:
                raise accepted.wrong(
                    "strips", strips, "none with several dumps or cameras: give the strips of one"
                )
            place = folder if folder is not None else scratch.path
            with executor_for(n_workers, None, sum(named.dump.pixels for named in several)) as executor:
                run_dumps(place, several, dataclasses.replace(request, executor=executor))
            made = read_result(place)
            return made if folder else dataclasses.replace(made, folder=None, _scratch=scratch)
        opened = several[0].dump
        if strips is not None:
            opened = opened.of_strips(
                [str(one) for one in accepted.listed(strips, "strips", "ids of strips")]
            )
        with executor_for(n_workers, None, opened.pixels) as executor:
            if folder is not None:
                run_dump(folder, opened, str(opened.root), dataclasses.replace(request, executor=executor))
                return read_result(folder)
            found = calibrate_dump(opened, chosen, None, executor, told)
        write_result(scratch.path, found, chosen)
        write_run(scratch.path, {"dump": str(opened.root)} | request.facts)
        made = read_result(scratch.path)
        return dataclasses.replace(made, folder=None, _scratch=scratch, _run=(opened, found, chosen))


MOST_WORKERS = 1024  # processes; a larger number is taken for a slip


def _folder_of(dump: DumpLike) -> Path:
    """Folder of a dump."""
    source = source_of_dump(dump)
    return source.root if isinstance(source, Dump) else dump_folder(source)


def source_of_dump(dump: object) -> str | Path | Dump:
    """A dump as `open_dump` takes it."""
    if isinstance(dump, Dump):
        return dump
    if not isinstance(dump, str | os.PathLike):
        raise accepted.wrong("dump", dump, "a path, an open Dump, or a sequence of them")
    return accepted.source_of(dump, "dump")


@contextmanager
def _in_words_of_python() -> Iterator[None]:
    """Errors of files name arguments of the function, not options of the command line."""
    try:
        yield
    except RawDataError as error:
        parts = (error.file, error.field, str(error.found), error.expected)
        plain = [re.sub(r"--([a-z][a-z-]*)", lambda word: word[1].replace("-", "_"), text) for text in parts]
        if tuple(plain) == parts:
            raise
        raise RawDataError(*plain) from error


def _settings_of(settings: PathLike | Settings | None) -> Settings:
    """The settings themselves, or those of a file, or all defaults."""
    if isinstance(settings, Settings):
        return settings
    if settings is not None and not isinstance(settings, str | os.PathLike):
        raise accepted.wrong("settings", settings, "the path of a TOML file, or Settings")
    return read_settings(None if settings is None else accepted.path_of(settings, "settings"))


def read_result(folder: PathLike) -> Calibration:
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
    ValueError
        If `folder` is no path.
    """
    place = accepted.path_of(folder, "folder")
    facts = read_json(place / "installation.json")
    of_vectors = facts.get("made_from") == "vectors"
    names = {name: facts.get(name) for name in ("frames", "stars", "targets", "chi2", "dof")}
    if missing := [name for name, value in names.items() if not isinstance(value, int | float)]:
        expected = "a number, as `calibrate` wrote it"
        raise RawDataError(str(place / "installation.json"), missing[0], names[missing[0]], expected)
    counts = f"{facts['frames']} exposures, {facts['stars']} stars, {facts['targets']} target sightings"
    cameras, R_cs, theta, cov_theta = read_matrices(place)
    return Calibration(
        R_cs=R_cs,
        theta=theta,
        cov_theta=cov_theta,
        cameras=cameras,
        chi2=float(facts["chi2"]),
        dof=int(facts["dof"]),
        counts=str(facts.get("counts", counts)),
        targets=_of_vectors(place, "targets") if of_vectors else _target_residuals(place),
        stars=_of_vectors(place, "stars") if of_vectors else None,
        not_used=_of_vectors(place, "ledger")[UNUSED]
        if of_vectors
        else read_sightings(place, "ledger", " ".join(UNUSED)).to_pandas(),
        facts=facts,
        saved=None if len(cameras) > 1 or of_vectors else read_saved_result(place),
        folder=place,
    )


def _of_vectors(folder: Path, table: str) -> pd.DataFrame:
    """A table of a result of vectors. `RawDataError` where it is damaged."""
    path = folder / "sightings" / f"{table}.parquet"
    rows = read_parquet(path)
    if missing := set(UNUSED) - set(rows.column_names) if table == "ledger" else set():
        raise RawDataError(str(path), "columns", f"none of {', '.join(sorted(missing))}", ", ".join(UNUSED))
    return rows.to_pandas()


def _target_residuals(folder: Path) -> pd.DataFrame:
    names = " ".join([*TARGETS, "normalised", "kept", "weight", "residual_c"])
    rows = read_sightings(folder, "targets", names).to_pandas()
    residual = np.array(rows["residual_c"].tolist(), dtype=float).reshape(-1, 2) / ARCSEC
    return rows[[*TARGETS]].assign(
        residual_x_arcsec=residual[:, 0],
        residual_y_arcsec=residual[:, 1],
        statistic=rows["normalised"],
        p_value=chdtrc(2, rows["normalised"].to_numpy()),
        kept=rows["kept"],
        weight=rows["weight"],
    )


def _star_residuals(folder: Path) -> pd.DataFrame:
    """Stars of a result; of several dumps those of each, with its name."""
    if names := dumps_in(folder):
        made = [name for name in names if (folder / name).is_dir()]
        parts = [_star_residuals(folder / name).assign(dump=name) for name in made]
        return pd.concat(parts, ignore_index=True)
    rows = read_sightings(folder, "stars", " ".join([*STARS, "xy_px", "residual_s"])).to_pandas()
    residual = np.array(rows["residual_s"].tolist(), dtype=float).reshape(-1, 3) / ARCSEC
    xy = np.array(rows["xy_px"].tolist(), dtype=float).reshape(-1, 2)
    found = rows[[*STARS]].rename(columns=STARS)
    return found.assign(
        x_px=xy[:, 0],
        y_px=xy[:, 1],
        residual_x_arcsec=residual[:, 0],
        residual_y_arcsec=residual[:, 1],
        p_value=chdtrc(2, found["statistic"].to_numpy()),
    )


def validate(result: Calibration | PathLike, dump: DumpLike) -> Validation:
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
        If the dump has no truth, or the result is not made from it.
    ValueError
        If the result is from vectors, or an argument is no path.
    """
    estimate = result if isinstance(result, Calibration) else read_result(result)
    if estimate.saved is None:
        raise ValueError("validate needs the result of a dump with one camera")
    flown = open_dump(source_of_dump(dump))
    if estimate._run is None:
        _, saved = read_for_dump(Path(estimate), flown.root)
    else:
        saved = estimate.saved
        if dump_identity(estimate._run[0].root) != dump_identity(flown.root):
            expected = "the dump that the result is made from"
            raise RawDataError(str(flown.root), "dump", "another dump", expected)
    return Validation(errors=against_truth(saved, flown))
