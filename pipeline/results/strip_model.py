"""The rigorous model of a strip as a finished result knows it: the attitude that its star exposures gave, its
installation matrix, the dump's camera and orbit. For everything that uses a calibration: geolocation,
exports.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import AttitudeTrack
from boresight.geometry.attitude_smoother import HeadRows, smoothed_track
from boresight.geometry.pushbroom import Pushbroom
from boresight.pipeline.errors import DataNotSufficientError, RawDataError, refusing
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_schema import DumpFile
from boresight.pipeline.files.object_store import dump_folder
from boresight.pipeline.files.strip_table import Strip
from boresight.pipeline.files.text_files import read_json, read_toml
from boresight.pipeline.results.ownership import MARKER, check_dump_of, dump_folder_of
from boresight.pipeline.results.reading import SavedResult, read_for_dump
from boresight.pipeline.run.settings import RunSettings, settings_from_values
from boresight.pipeline.stages.coverage import rows_not_covered, rows_of_heads
from boresight.records.record import Ints, record, scalar

__all__ = [
    "Calibrated",
    "StripModel",
    "attitude_track",
    "exposures_around",
    "open_calibrated",
    "pushbroom_with",
    "run_settings_of",
    "strip_model",
    "terrain_sigma_m",
    "whole_strip_model",
]


@record(kw_only=True)
class Calibrated:
    """A result and the dump that it was made from."""

    result: SavedResult = scalar("finished result")
    folder: Path = scalar("its folder, of several dumps that of this one")
    dump: Dump = scalar("dump from which it was made")
    sigma_terrain_m: float = scalar("1 sigma of the heights, m; 0 without a terrain model (unknown)")
    exposure_margin_s: float = scalar("exposures within this time of a strip belong to it, s")


@record
class StripModel:
    """One strip: pixel <-> ground."""

    strip: Strip = scalar("strip of the dump")
    pushbroom: Pushbroom = scalar("rigorous model: pixel <-> ground")
    track: AttitudeTrack = scalar("attitudes of the strip's exposures")


def open_calibrated(
    result: Path, dump: Path | None, *, camera: str = "", allow_stale_eop: bool = False
) -> Calibrated:
    """A finished result with its dump: the one given, or else the one that the run's notes name. Of several
    dumps, one must be given, of several cameras one must be named; it comes with the joint matrix.
    """
    folder, saved = read_for_dump(result, dump, camera)
    run = run_settings_of(saved, str(result / "installation.json"))
    root = dump if dump is not None else _noted_dump(folder if camera else result)
    check_dump_of(folder, root)
    opened = open_dump(root, camera=camera or None, allow_stale_eop=allow_stale_eop)
    return Calibrated(
        result=saved,
        folder=folder,
        dump=opened,
        sigma_terrain_m=terrain_sigma_m(opened),
        exposure_margin_s=run.exposure_margin_s,
    )


def terrain_sigma_m(dump: Dump) -> float:
    """1 sigma of the heights of a dump, m; 0 without a terrain model."""
    terrain = read_toml(dump.root / "dump.toml", DumpFile, "dump.toml").terrain
    return terrain.sigma_m if terrain is not None else 0.0


def strip_model(calibrated: Calibrated, strip_id: str) -> StripModel:
    """The model of a strip; `RawDataError`: not in the dump, `DataNotSufficientError`: rows not covered."""
    dump, result = calibrated.dump, calibrated.result
    strips = {strip.strip_id: strip for strip in dump.strips}
    if strip_id not in strips:
        raise RawDataError("strips.csv", "id", strip_id, f"one of {', '.join(sorted(strips))}")
    strip = strips[strip_id]
    near = exposures_around(result, dump, strip, calibrated.exposure_margin_s)
    if len(near) < 2:
        reason = f"strip {strip_id}: {len(near)} usable star exposures around it, 2 are needed"
        raise DataNotSufficientError(reason)
    track = attitude_track(result, dump, near)
    return StripModel(strip, pushbroom_with(track, strip, dump, result.R_cs), track)


def attitude_track(result: SavedResult, dump: Dump, near: Ints) -> AttitudeTrack:
    """Attitude through exposures (K,) of a result: smoothed where the calibration smooths it, too."""
    t_s, head = result.t_exposures_s[near], dump.heads[0]
    gyro = head.gyro_around(t_s, dump.orbit)
    if head.is_smoothed:
        rows = rows_of_heads(dump, t_s, _mountings(result, dump))
    elif gyro is not None and head.interpolation == "lagrange":
        R_so = result.R_si[near] * dump.orbit.R_oi(t_s).inv()
        rows = [HeadRows(t_s=t_s, R_so=R_so, covariance_s=result.covariance_s[near], noise=head.noise)]
    else:
        own = result.covariance_s[near]
        return AttitudeTrack(t_s, result.R_si[near], dump.orbit, own, interpolation=head.interpolation)
    every = t_s if gyro is None else np.unique(np.concatenate([rows[0].t_s, gyro.t_s]))
    return smoothed_track(rows, dump.orbit, gyro=gyro, t_s=every)


def _mountings(result: SavedResult, dump: Dump) -> dict[str, Rotation]:
    """Installation matrices of the dump's heads, those of the result where it has several."""
    stated = {head.name: head.R_cs0 for head in dump.heads} | {dump.heads[0].name: result.R_cs}
    found = result.installation.get("heads") or []
    return stated | {one["name"]: Rotation.from_matrix(one["R_cs"]) for one in found}


def whole_strip_model(calibrated: Calibrated, strip_id: str) -> StripModel:
    """The model of one strip, as `strip_model`, for products of all of its rows. `DataNotSufficientError`
    also for a strip of which star exposures cover some rows only.
    """
    model = strip_model(calibrated, strip_id)
    if reason := rows_not_covered(model.track.t_s, *calibrated.dump.span_s(model.strip)):
        raise DataNotSufficientError(f"strip {strip_id}: {reason}")
    return model


def exposures_around(result: SavedResult, dump: Dump, strip: Strip, margin_s: float) -> Ints:
    """Rows (K,) of the result's usable star exposures from `margin_s` before a strip to as much after it."""
    first, last = dump.span_s(strip)
    t = result.t_exposures_s
    return np.flatnonzero(result.usable & (t >= first - margin_s) & (t <= last + margin_s))


def pushbroom_with(track: AttitudeTrack, strip: Strip, dump: Dump, R_cs: Rotation) -> Pushbroom:
    """The rigorous model of a strip with given attitudes and installation matrix."""
    return Pushbroom(
        camera=dump.line_camera,
        rows=strip.clock,
        orbit=dump.orbit,
        earth=dump.orbit.earth,
        attitude=track,
        R_cs=R_cs,
        effects=dump.light,
    )


def run_settings_of(saved: SavedResult, file: str) -> RunSettings:
    """The settings that a result was made with; `RawDataError`, which names `file`, where it has none."""
    settings = saved.installation.get("settings")
    run = settings.get("run") if isinstance(settings, dict) else None
    if not isinstance(run, dict):
        raise RawDataError(file, "settings.run", type(run).__name__, "an object, as `calibrate` wrote it")
    return settings_from_values(RunSettings, run, file, "settings.run")


def _noted_dump(result: Path) -> Path:
    if (result / MARKER).is_file():
        return dump_folder_of(result)
    path = result / "run.json"  # of a result in memory, or of a version that wrote no marker
    with refusing(str(path), "dump", "the dump's folder; or give --dump", (KeyError, TypeError)):
        noted = dump_folder(read_json(path)["dump"])
    if not noted.is_dir():
        expected = "the folder that the result was made from; give it with --dump"
        raise RawDataError(str(path), "dump", f"{noted}, which is no folder", expected)
    return noted
