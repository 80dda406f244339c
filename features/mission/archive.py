"""A mission's archive: its results in one SQLite file, their information in Parquet files beside it.

    ARCHIVE/archive.gpkg               a GeoPackage: tables results, tracks, targets, unknowns, totals
    ARCHIVE/information/ID.parquet     information pair of theta and the camera's distortion

A result is in the archive when its row is committed; nothing is ever changed or removed. Writers wait for one
another. A Parquet file without a row was left by a process that was killed, and the next writer removes it.

`results.pair` holds of each result's pair the rows of theta, and `totals` the sum of the rest over the
results of a series that are not refuted, so that a course over years needs no other file. Results of a series
that have a strip in common share its errors: the one added last counts, the others do not.
"""

from __future__ import annotations

import json
import os
import sqlite3
import struct
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from boresight.calib.distortion import prior_information
from boresight.calib.information import InformationPairs
from boresight.calib.verdict import Outcome
from boresight.features.mission.mounting_course import MountingSeries, with_reference_moved
from boresight.features.mission.saved_mounting import ORIGIN, SavedMounting, read_saved_mounting
from boresight.geometry.installation import theta_between
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.table_files import read_parquet
from boresight.pipeline.files.whole_file import remove_abandoned, write_whole
from boresight.pipeline.results.folder import results_in
from boresight.pipeline.results.identity import result_id
from boresight.pipeline.results.reading import pairs_in
from boresight.pipeline.results.sightings_tables import pairs_table
from boresight.records.record import array, record, scalar

__all__ = ["ArchivedSeries", "add_mounting", "add_results", "series_of"]

FILE, INFORMATION = "archive.gpkg", "information"
SERIES = ("mission", "satellite", "camera", "head", "model")  # results alike in these are one series
SAME_INSTANT_S = 1e-3  # strips whose middles are nearer are one
LONGEST_WAIT_S = 120.0  # for another writer
GEOPACKAGE = 0x47504B47  # application_id of such a file: "GPKG"
WGS84_ID = 4326  # EPSG
SCHEMA = f"""
CREATE TABLE IF NOT EXISTS gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL,
  description TEXT);
CREATE TABLE IF NOT EXISTS gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL,
  identifier TEXT UNIQUE, description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT
  (strftime('%Y-%m-%dT%H:%M:%fZ','now')), min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE,
  srs_id INTEGER);
CREATE TABLE IF NOT EXISTS gpkg_geometry_columns (table_name TEXT NOT NULL PRIMARY KEY,
  column_name TEXT NOT NULL, geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL,
  z TINYINT NOT NULL, m TINYINT NOT NULL);
INSERT OR IGNORE INTO gpkg_spatial_ref_sys VALUES
  ('Undefined cartesian', -1, 'NONE', -1, 'undefined', NULL), ('Undefined geographic', 0, 'NONE', 0,
  'undefined', NULL), ('WGS 84', {WGS84_ID}, 'EPSG', {WGS84_ID}, 'GEOGCS["WGS 84",DATUM["WGS_1984",
SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]]', NULL);
INSERT OR IGNORE INTO gpkg_contents (table_name, data_type, identifier, srs_id) VALUES
  ('results', 'attributes', 'results', 0), ('tracks', 'features', 'tracks', {WGS84_ID}),
  ('targets', 'features', 'targets', {WGS84_ID});
INSERT OR IGNORE INTO gpkg_geometry_columns VALUES ('tracks', 'geom', 'LINESTRING', {WGS84_ID}, 0, 0),
  ('targets', 'geom', 'POINT', {WGS84_ID}, 0, 0);
CREATE TABLE IF NOT EXISTS unknowns (fid INTEGER PRIMARY KEY, names TEXT NOT NULL UNIQUE);
CREATE TABLE IF NOT EXISTS totals (series TEXT NOT NULL, unknowns INTEGER NOT NULL, results INTEGER NOT NULL,
  F BLOB NOT NULL, right BLOB NOT NULL, PRIMARY KEY (series, unknowns));
CREATE TABLE IF NOT EXISTS results (fid INTEGER PRIMARY KEY, id TEXT NOT NULL UNIQUE, utc TEXT NOT NULL,
  t_s REAL NOT NULL, series TEXT NOT NULL, mission TEXT, satellite TEXT, camera TEXT, head TEXT, model TEXT,
  star_camera TEXT, verdict TEXT, folder TEXT, program TEXT, inputs TEXT, dump TEXT, qx REAL, qy REAL,
  qz REAL, qw REAL, covariance_rad2 TEXT, ground_m_per_rad TEXT, cos_u REAL, sin_u REAL, beta_rad REAL,
  temperature_c REAL, reference TEXT, unknowns INTEGER, pair BLOB, added_utc TEXT);
CREATE INDEX IF NOT EXISTS results_of_series ON results (series, t_s);
CREATE TABLE IF NOT EXISTS tracks (fid INTEGER PRIMARY KEY, geom BLOB, result TEXT, strip TEXT, utc TEXT,
  t_s REAL);
CREATE INDEX IF NOT EXISTS tracks_of_results ON tracks (result);
CREATE TABLE IF NOT EXISTS targets (fid INTEGER PRIMARY KEY, geom BLOB, result TEXT, strip TEXT, target TEXT,
  state TEXT, residual_m REAL);
PRAGMA application_id = {GEOPACKAGE};
PRAGMA user_version = 10300;
"""


@record(kw_only=True)
class ArchivedSeries:
    """Results of one camera and one star camera in the order of time."""

    key: tuple[str, ...] = scalar("mission, satellite, camera, head, digest of the camera's model")
    series: MountingSeries = scalar("those of the course: neither refuted nor of strips that a later one has")
    R_cs_ref: Rotation = array("K", "reference of each: theta of the course is the deviation from it")
    rows: tuple[dict[str, Any], ...] = array("K", "what the table says of them")
    left_out: tuple[dict[str, Any], ...] = scalar("the others, with `reason`")


def add_results(folders: Sequence[Path], archive: Path) -> list[tuple[Path, str]]:
    """Add finished results, each dump of a joint one by itself; each folder with what became of it: "added"
    or "there already". `RawDataError` for a folder that holds no finished result, or a damaged one.
    """
    told = []
    with closing(_connected(archive)) as database:
        _sweep(archive, database)
        for folder in (one for given in folders for one in results_in(given)):
            if not (folder / "installation.json").is_file():
                raise RawDataError(str(folder), "installation.json", "missing", "a finished result")
            there = database.execute("SELECT 1 FROM results WHERE id = ?", [result_id(folder)]).fetchone()
            is_new = not there and _add(archive, database, read_saved_mounting(folder))
            told.append((folder, "added" if is_new else "there already"))
    return told


def add_mounting(saved: SavedMounting, archive: Path) -> bool:
    """Add one result; whether it was not there."""
    with closing(_connected(archive)) as database:
        return _add(archive, database, saved)


def series_of(archive: Path) -> list[ArchivedSeries]:
    """All series of an archive that have results for a course; `RawDataError` where there is none."""
    if not (archive / FILE).is_file():
        raise RawDataError(str(archive), FILE, "no such file", "an archive that `archive add` made")
    with closing(_connected(archive)) as database:
        database.row_factory = sqlite3.Row
        names = [row["series"] for row in database.execute("SELECT DISTINCT series FROM results ORDER BY 1")]
        return [found for name in names if (found := _series(archive, database, name)) is not None]


def _connected(archive: Path) -> sqlite3.Connection:
    (archive / INFORMATION).mkdir(parents=True, exist_ok=True)
    database = sqlite3.connect(archive / FILE, timeout=LONGEST_WAIT_S, isolation_level=None)
    try:
        if database.execute("PRAGMA application_id").fetchone()[0] != GEOPACKAGE:
            with _writing(database):
                for statement in SCHEMA.split(";\n"):
                    database.execute(statement)
    except sqlite3.DatabaseError as error:
        database.close()
        raise RawDataError(str(archive / FILE), "file", str(error), "an archive's SQLite file") from error
    return database


@contextmanager
def _writing(database: sqlite3.Connection) -> Iterator[None]:
    """One transaction; other writers wait from its begin to its end."""
    database.execute("BEGIN IMMEDIATE")
    try:
        yield
    except BaseException:
        database.execute("ROLLBACK")
        raise
    database.execute("COMMIT")


def _sweep(archive: Path, database: sqlite3.Connection) -> None:
    """Remove the information of results that have no row."""
    folder = archive / INFORMATION
    if len(os.listdir(folder)) <= database.execute("SELECT count(*) FROM results").fetchone()[0]:
        return
    with _writing(database):  # no other writer is between its file and its row
        ids = {row[0] for row in database.execute("SELECT id FROM results")}
        for path in folder.glob("*.parquet"):
            if path.stem not in ids:
                path.unlink()
    remove_abandoned(folder)


def _add(archive: Path, database: sqlite3.Connection, saved: SavedMounting) -> bool:
    """Whether the result was not there yet, and is now."""
    pair, n = saved.pair, 3 + len(saved.pair.shared)
    series = json.dumps([getattr(saved, name) for name in SERIES])
    own = np.concatenate([pair.F[0, :3].ravel(), pair.F_theta[0, :3]])
    values: dict[str, Any] = {name: getattr(saved, name) for name in SERIES}
    values |= {"id": saved.id, "utc": saved.utc, "t_s": saved.t_s, "series": series}
    values |= {"star_camera": saved.star_camera, "verdict": saved.verdict, "folder": str(saved.folder)}
    values |= {name: saved.facts[name] for name in ("program", "inputs", "dump")}
    values |= dict(zip(("qx", "qy", "qz", "qw"), saved.R_cs.as_quat(canonical=True).tolist()))
    values |= {"covariance_rad2": json.dumps(saved.covariance.tolist())}
    values |= {"ground_m_per_rad": json.dumps([_known(one) for one in saved.ground_m_per_rad])}
    values |= {"cos_u": float(saved.cos_sin[0]), "sin_u": float(saved.cos_sin[1])}
    values |= {"beta_rad": _known(saved.beta_rad), "temperature_c": _known(saved.temperature_c)}
    values |= {"reference": json.dumps(pair.R_cs_ref.as_quat().tolist()), "pair": own.tobytes()}
    values |= {"added_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}
    targets = _targets(saved)
    with _writing(database):
        if database.execute("SELECT 1 FROM results WHERE id = ?", [saved.id]).fetchone():
            return False
        write_whole(
            archive / INFORMATION / f"{saved.id}.parquet",
            lambda path: pq.write_table(pairs_table(pair), path, compression="zstd", use_dictionary=False),
        )
        names = json.dumps(pair.shared)
        database.execute("INSERT OR IGNORE INTO unknowns (names) VALUES (?)", [names])
        (unknowns,) = database.execute("SELECT fid FROM unknowns WHERE names = ?", [names]).fetchone()
        values["unknowns"] = unknowns
        marks = ", ".join("?" * len(values))
        database.execute(f"INSERT INTO results ({', '.join(values)}) VALUES ({marks})", [*values.values()])
        if saved.verdict != Outcome.REFUTED.value:
            before = database.execute(
                "SELECT results, F, right FROM totals WHERE series = ? AND unknowns = ?", [series, unknowns]
            ).fetchone()
            count, F, right = before or (0, np.zeros((n - 3) ** 2).tobytes(), np.zeros(n - 3).tobytes())
            F_sum = np.frombuffer(F) + pair.F[0, 3:, 3:].ravel()
            right_sum = np.frombuffer(right) + pair.F_theta[0, 3:]
            total = [series, unknowns, count + 1, F_sum.tobytes(), right_sum.tobytes()]
            database.execute("INSERT OR REPLACE INTO totals VALUES (?, ?, ?, ?, ?)", total)
        database.executemany(
            "INSERT INTO tracks (geom, result, strip, utc, t_s) VALUES (?, ?, ?, ?, ?)", _tracks(saved)
        )
        database.executemany(
            "INSERT INTO targets (geom, result, strip, target, state, residual_m) VALUES (?, ?, ?, ?, ?, ?)",
            targets,
        )
    return True


def _tracks(saved: SavedMounting) -> list[tuple[Any, ...]]:
    """Rows of the table of tracks, one a strip; without a line where the result does not say where it is."""
    t_s = ORIGIN.seconds_from_utc(saved.strips_utc.tolist()).tolist() if len(saved.strips) else []
    rows = zip(saved.track_deg.tolist(), saved.strips.tolist(), saved.strips_utc.tolist(), t_s)
    return [
        (_geometry([(b, a), (d, c)]) if np.isfinite([a, b, c, d]).all() else None, saved.id, *strip)
        for (a, b, c, d), *strip in rows
    ]


def _targets(saved: SavedMounting) -> list[tuple[Any, ...]]:
    """Rows of the table of targets; none of a result without report."""
    path = saved.folder / "evidence" / "ground.parquet"
    if not path.is_file():
        return []
    names = ("strip_id", "target_id", "state", "residual_m", "lon_deg", "lat_deg")
    table = read_parquet(path)
    columns = [table.column(name).to_pylist() for name in names]
    return [
        (_geometry([(lon, lat)]), saved.id, strip, target, state, _known(residual))
        for strip, target, state, residual, lon, lat in zip(*columns)
    ]


def _geometry(points: Sequence[tuple[float, float]]) -> bytes:
    """A point or a line of (longitude, latitude), degrees, as a GeoPackage has it: its head, then WKB."""
    head = b"GP\x00\x01" + struct.pack("<i", WGS84_ID)
    body = b"".join(struct.pack("<2d", *point) for point in points)
    if len(points) == 1:
        return head + b"\x01" + struct.pack("<I", 1) + body
    return head + b"\x01" + struct.pack("<II", 2, len(points)) + body


def _known(value: float | None) -> float | None:
    return None if value is None or not np.isfinite(value) else float(value)


def _series(archive: Path, database: sqlite3.Connection, name: str) -> ArchivedSeries | None:
    every = database.execute("SELECT * FROM results WHERE series = ? ORDER BY t_s, fid", [name]).fetchall()
    reasons = {row["id"]: "refuted" for row in every if row["verdict"] == Outcome.REFUTED.value}
    sharing = _sharing(database, name, [row for row in every if row["id"] not in reasons])
    reasons |= sharing
    used = [row for row in every if row["id"] not in reasons]
    left_out = [dict(row) | {"reason": reasons[row["id"]]} for row in every if row["id"] in reasons]
    if not used:
        return None
    names = {row["fid"]: json.loads(row["names"]) for row in database.execute("SELECT * FROM unknowns")}
    shared = tuple(sorted({one for row in used for one in names[row["unknowns"]]}))
    place = {
        fid: np.array([shared.index(one) for one in own], dtype=int)
        for fid, own in names.items()
        if set(own) <= set(shared)
    }
    K, S = len(used), len(shared)
    F_shared, F, right = np.zeros((K, 3, S)), np.empty((K, 3, 3)), np.empty((K, 3))
    for k, row in enumerate(used):
        numbers = np.frombuffer(row["pair"])
        of_theta, right[k] = numbers[:-3].reshape(3, -1), numbers[-3:]
        F[k], F_shared[k][:, place[row["unknowns"]]] = of_theta[:, :3], of_theta[:, 3:]
    shared_F, shared_right = prior_information(shared), np.zeros(S)
    for row in database.execute("SELECT * FROM totals WHERE series = ?", [name]):
        at = place[row["unknowns"]]
        shared_F[np.ix_(at, at)] += np.frombuffer(row["F"]).reshape(len(at), -1)
        shared_right[at] += np.frombuffer(row["right"])
    for id in sharing:
        pair: InformationPairs = pairs_in(archive / INFORMATION / f"{id}.parquet").widened(shared)
        shared_F -= pair.F[0, 3:, 3:]
        shared_right -= pair.F_theta[0, 3:]
    series = MountingSeries(
        names=tuple(row["id"] for row in used),
        t_s=np.array([row["t_s"] for row in used]),
        F=F,
        F_shared=F_shared,
        right=right,
        shared_F=shared_F,
        shared_right=shared_right,
        cos_sin=np.array([(row["cos_u"], row["sin_u"]) for row in used], dtype=float),
        beta_rad=np.array([row["beta_rad"] for row in used], dtype=float),
        temperature_c=np.array([row["temperature_c"] for row in used], dtype=float),
        exchanges=tuple(k for k in range(1, K) if used[k]["star_camera"] != used[k - 1]["star_camera"]),
    )
    own = Rotation.from_quat(np.array([json.loads(row["reference"]) for row in used]))
    first = np.maximum.accumulate([k if k in series.exchanges else 0 for k in range(K)])
    R_cs_ref = own[first]
    shift = theta_between(own, R_cs_ref)
    return ArchivedSeries(
        key=tuple(json.loads(name)),
        series=with_reference_moved(series, shift),
        R_cs_ref=R_cs_ref,
        rows=tuple(dict(row) for row in used),
        left_out=tuple(left_out),
    )


def _sharing(database: sqlite3.Connection, name: str, rows: Sequence[sqlite3.Row]) -> dict[str, str]:
    """Results of a series that have a strip in common with one added later that counts, and how many."""
    found = database.execute(
        "SELECT result, tracks.t_s FROM tracks JOIN results ON results.id = result WHERE series = ? "
        "AND tracks.t_s IS NOT NULL ORDER BY tracks.t_s",
        [name],
    ).fetchall()
    apart = np.diff(np.array([t_s for _, t_s in found]), prepend=-np.inf) > SAME_INSTANT_S
    strips: dict[str, list[int]] = {}
    for (result, _), strip in zip(found, np.cumsum(apart).tolist()):
        strips.setdefault(result, []).append(strip)
    counted: dict[int, str] = {}
    reasons: dict[str, str] = {}
    for row in sorted(rows, key=lambda row: row["fid"], reverse=True):
        own = strips.get(row["id"], [])
        if shared := [counted[strip] for strip in own if strip in counted]:
            later = ", ".join(dict.fromkeys(shared))
            reasons[row["id"]] = f"{len(shared)} of its {len(own)} strips are in {later}, added later"
        else:
            counted |= dict.fromkeys(own, row["id"])
    return reasons
