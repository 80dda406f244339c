"""Other readings of the tables of a dump: what its times and measured points would be, had their writer meant
another scale of time, another corner of the image, or the columns in another order.

Each moves strips or points by kilometres: far from any linear test.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np

from boresight.geometry.constants import WGS84
from boresight.geometry.epoch import GPS_MINUS_TAI_S, tai_minus_utc_s
from boresight.geometry.geodesy import ecef_from_geodetic, geodetic_from_ecef
from boresight.geometry.record import Floats, record, scalar
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.ground_points import StripPoints
from boresight.pipeline.files.strip_table import Strip

__all__ = ["Convention", "other_readings"]

MOST_EXCHANGED = 6  # strips whose measured points are exchanged pair by pair: the work grows with the square


@record(kw_only=True)
class Convention:
    """A dump with one convention changed."""

    cause: str = scalar("what would be wrong")
    item: str = scalar("what it concerns")
    changed: str = scalar("what is changed, in words")
    file: str = scalar("file of the dump that states it")
    field: str = scalar("field of that file")
    dump: Dump = scalar("the dump with it changed")


def other_readings(dump: Dump) -> Iterator[Convention]:
    """Every other reading alone."""
    yield from _times_of_strips(dump)
    if dump.points:
        yield from _image_points(dump)
        yield from _coordinates(dump)
        yield from _exchanged(dump)


def _times_of_strips(dump: Dump) -> Iterator[Convention]:
    """Times of GPS or TAI that were written as UTC."""
    leap_s = float(tai_minus_utc_s(dump.epoch.mjd_tai(0.0)))
    for scale, offset_s in (("GPS time", -GPS_MINUS_TAI_S - leap_s), ("TAI", -leap_s)):
        strips, sky = (
            tuple(replace(one, t_first_row_s=one.t_first_row_s + offset_s) for one in those)
            for those in (dump.strips, dump.sky_strips)
        )
        yield Convention(
            cause="scale of times",
            item="all strips",
            changed=f"read as {scale} ({offset_s:+.0f} s)",
            file="strips.csv",
            field="utc_first_row",
            dump=replace(dump, strips=strips, sky_strips=sky),
        )


def _image_points(dump: Dump) -> Iterator[Convention]:
    """Lines counted from the last, samples from the other end, both exchanged."""
    strips = {one.strip_id: one for one in dump.strips}

    def lines(points: StripPoints, strip: Strip) -> Floats:
        last = np.array([strip.ccd_lines[ccd] - 1 for ccd in points.ccd.tolist()], dtype=float)
        return np.column_stack([points.xy_px[:, 0], last - points.xy_px[:, 1]])

    def other_end(points: StripPoints, strip: Strip) -> Floats:
        last = np.array([dump.line_camera.n_px(ccd) - 1 for ccd in points.ccd.tolist()], dtype=float)
        return np.column_stack([last - points.xy_px[:, 0], points.xy_px[:, 1]])

    def columns(points: StripPoints, strip: Strip) -> Floats:
        return points.xy_px[:, ::-1]

    readings: tuple[tuple[str, str, str, Callable[[StripPoints, Strip], Floats]], ...] = (
        ("origin of the lines", "with lines counted from the last", "line", lines),
        ("origin of the samples", "with samples counted from the other end", "sample", other_end),
        ("order of the columns", "with sample and line exchanged,", "sample, line", columns),
    )
    for cause, changed, field, moved in readings:
        points = tuple(replace(one, xy_px=moved(one, strips[one.strip_id])) for one in dump.points)
        yield _of_points(dump, cause, changed, field, points)


def _coordinates(dump: Dump) -> Iterator[Convention]:
    """Latitude and longitude exchanged, or one of them with the other sign."""

    def at(lat: Floats, lon: Floats, name: str) -> tuple[Floats, Floats]:
        return {"order": (lon, lat), "lat_deg": (-lat, lon), "lon_deg": (lat, -lon)}[name]

    for name, cause, changed, field in (
        ("order", "order of the columns", "with latitude and longitude exchanged,", "lat_deg, lon_deg"),
        ("lat_deg", "sign of the latitudes", "with the other sign", "lat_deg"),
        ("lon_deg", "sign of the longitudes", "with the other sign", "lon_deg"),
    ):
        moved = []
        for points in dump.points:
            lat, lon, height = geodetic_from_ecef(np.array([one.p_e for one in points.targets]), WGS84)
            p_e = ecef_from_geodetic(*at(lat, lon, name), height, WGS84)
            targets = tuple(replace(one, p_e=place) for one, place in zip(points.targets, p_e))
            moved.append(replace(points, targets=targets))
        yield _of_points(dump, cause, changed, field, tuple(moved))


def _exchanged(dump: Dump) -> Iterator[Convention]:
    """The points of two strips under one another's names."""
    for a, b in combinations(range(min(len(dump.points), MOST_EXCHANGED)), 2):
        points, names = list(dump.points), (dump.points[a].strip_id, dump.points[b].strip_id)
        points[a], points[b] = (replace(points[n], strip_id=name) for n, name in zip((b, a), names))
        changed = _of_points(dump, "points of two strips", "exchanged,", "strip", tuple(points))
        yield replace(changed, item=f"strips {names[0]} and {names[1]}")


def _of_points(
    dump: Dump, cause: str, changed: str, field: str, points: tuple[StripPoints, ...]
) -> Convention:
    return Convention(
        cause=cause,
        item="all measured points",
        changed=changed,
        file="points.csv",
        field=field,
        dump=replace(dump, points=points),
    )
