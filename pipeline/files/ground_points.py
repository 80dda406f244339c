"""Places on the ground: surveyed targets, and points whose positions in a strip are measured already."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from boresight.gct_match.records import GroundReference, Target
from boresight.geometry.geodesy import ecef_from_geodetic
from boresight.geometry.geoid import egm96
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.text_files import each_once, path_inside, read_table
from boresight.records.record import Floats, Ints, RowRecord, array, record, scalar

__all__ = [
    "NO_POINTS",
    "NO_TARGETS",
    "ChipFile",
    "StripPoints",
    "SurveyedPoints",
    "read_points",
    "read_targets",
]

# Columns of a point, in the order of docs/dump-format.md.
OF_PLACE = "lat_deg lon_deg height_m height_kind sigma_east_m sigma_north_m sigma_up_m reference".split()


@record
class SurveyedPoints(RowRecord):
    """Points on the ground. Row n of every array is the same point."""

    targets: tuple[Target, ...] = array("N", "ids, ITRS positions and sigmas")
    lat_rad: Floats = array("N", "geodetic latitude, WGS84")
    lon_rad: Floats = array("N", "longitude, positive to the east")
    height_m: Floats = array("N", "height above the ellipsoid")


NO_TARGETS = SurveyedPoints((), np.zeros(0), np.zeros(0), np.zeros(0))


@record
class ChipFile:
    """Image file of a target's chip."""

    target_id: str = scalar("id of the target")
    file: str = scalar("path as targets.csv gives it")
    path: Path = scalar("path of the image")


@record(kw_only=True)
class StripPoints(RowRecord):
    """Measured image points of one strip. Row n of every array is the same measurement."""

    strip_id: str = scalar("id of the strip in the dump")
    targets: tuple[Target, ...] = array("N", "the points on the ground")
    ccd: Ints = array("N", "CCD of the camera, from 0")
    xy_px: Floats = array("N, 2", "measured position (sample, line)")
    cov_px: Floats = array("N, 2, 2", "its covariance, px²")

    def of(self, ccds: Sequence[int]) -> StripPoints:
        """The measurements in some of the CCDs."""
        return self.take(np.isin(self.ccd, ccds))


# A strip without measured points.
NO_POINTS = StripPoints(
    strip_id="",
    targets=(),
    ccd=np.zeros(0, dtype=np.int64),
    xy_px=np.zeros((0, 2)),
    cov_px=np.zeros((0, 2, 2)),
)


References = Mapping[str, GroundReference]


def read_targets(
    root: Path, path: Path, file: str, references: References
) -> tuple[SurveyedPoints, tuple[ChipFile, ...]]:
    """The targets of targets.csv, which name their `references`, and the file of each one's chip in the dump
    of folder `root`.

    `RawDataError` for a table that is not valid, names a target twice, or has none.
    """
    rows = read_table(path, schema.TargetRow, file, "at least one target")
    each_once([row.id for row in rows], file)
    chips = tuple(
        ChipFile(row.id, row.chip, path_inside(root, row.chip, file=file, field=f"line {n + 2}, chip"))
        for n, row in enumerate(rows)
    )
    return _surveyed(rows, file, references), chips


def read_points(
    path: Path, file: str, references: References
) -> tuple[tuple[StripPoints, ...], SurveyedPoints]:
    """Measured image points strip by strip, and the points on the ground; `RawDataError` if not valid.

    The rows of one id are one point on the ground and must agree in its coordinates.
    """
    rows = read_table(path, schema.PointRow, file, "at least one point")
    first: dict[str, schema.PointRow] = {}
    seen: set[tuple[str, str, int]] = set()
    for n, row in enumerate(rows):
        reference = first.setdefault(row.id, row)
        for name in OF_PLACE:
            if (got := getattr(row, name)) != (expected := getattr(reference, name)):
                raise RawDataError(file, f"line {n + 2}, {name}", got, f"{expected}, as before for {row.id}")
        if (key := (row.strip, row.id, row.ccd)) in seen:
            found = f"{row.id} again in strip {row.strip}, CCD {row.ccd}"
            raise RawDataError(file, f"line {n + 2}, id", found, "each point once in a CCD of a strip")
        seen.add(key)
    surveyed = _surveyed(list(first.values()), file, references)
    place = {target.target_id: target for target in surveyed.targets}
    strips: dict[str, list[schema.PointRow]] = {}
    for row in rows:
        strips.setdefault(row.strip, []).append(row)
    return tuple(_of_strip(name, own, place) for name, own in strips.items()), surveyed


def _of_strip(name: str, rows: list[schema.PointRow], place: dict[str, Target]) -> StripPoints:
    rows = sorted(rows, key=lambda row: (row.id, row.ccd))
    sigma = np.array([[row.sigma_sample_px, row.sigma_line_px] for row in rows])
    return StripPoints(
        strip_id=name,
        targets=tuple(place[row.id] for row in rows),
        ccd=np.array([row.ccd for row in rows], dtype=np.int64),
        xy_px=np.array([[row.sample, row.line] for row in rows]),
        cov_px=sigma[:, :, None] ** 2 * np.eye(2),
    )


def _surveyed(
    rows: Sequence[schema.TargetRow | schema.PointRow], file: str, references: References
) -> SurveyedPoints:
    """Rows of a table as points with ITRS positions and ellipsoidal heights."""
    for row in rows:
        if row.reference and row.reference not in references:
            expected = f"one of [[ground_references]]: {', '.join(references) or 'there are none'}"
            raise RawDataError(file, f"reference of {row.id}", row.reference, expected)
    lat = np.radians([row.lat_deg for row in rows])
    lon = np.radians([row.lon_deg for row in rows])
    height = np.array([row.height_m for row in rows], dtype=float)
    orthometric = np.array([row.height_kind == "egm96" for row in rows], dtype=bool)
    if orthometric.any():
        height[orthometric] += egm96().undulation_m(lat[orthometric], lon[orthometric])
    p_e = ecef_from_geodetic(lat, lon, height)
    targets = tuple(
        Target(
            row.id,
            p,
            np.array([row.sigma_east_m, row.sigma_north_m, row.sigma_up_m]),
            references.get(row.reference),
        )
        for row, p in zip(rows, p_e)
    )
    return SurveyedPoints(targets, lat, lon, height)
