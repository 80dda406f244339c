"""Targets that share the pixels of another one: two templates with the same pixels have the same error."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from boresight.gct_match.settings import MatchSettings
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, local_axes_e
from boresight.geometry.ledger import Entry, Kind, Reason, Subject
from boresight.geometry.record import Floats
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump import Dump
from boresight.pipeline.files.ground_points import ChipFile
from boresight.pipeline.files.images.rasters import grid_place

__all__ = ["targets_once"]

SHARED = 0.25  # of a template's pixels: errors of two targets then correlate by as much


def targets_once(dump: Dump, settings: MatchSettings) -> Dump:
    """The dump without targets whose templates share more than a quarter of their pixels with that of one
    that stays, and with omissions for these. The first in the order of targets.csv stays.
    """
    why = _shared(dump, settings.template_px * _pixel_m(dump)) if len(dump.targets) > 1 else {}
    if not why:
        return dump
    omitted = [
        Entry(Subject(Kind.TARGET, id=dump.targets[n].target_id), Reason.REPEATED, why[n], dump.chips[n].file)
        for n in sorted(why)
    ]
    left = [n for n in range(len(dump.targets)) if n not in why]
    return replace(
        dump,
        targets=tuple(dump.targets[n] for n in left),
        chips=tuple(dump.chips[n] for n in left),
        omissions=(*dump.omissions, *omitted),
    )


def _shared(dump: Dump, template_m: float) -> dict[int, str]:
    """Why targets are left out, by their rows; a template is at most `template_m` wide on the ground."""
    p_e = np.array([target.p_e for target in dump.targets])
    pairs = cKDTree(p_e).query_pairs(np.sqrt(2.0) * template_m, output_type="ndarray")
    why: dict[int, str] = {}
    for first, second in sorted(map(tuple, np.sort(pairs, axis=1).tolist()), key=lambda pair: pair[::-1]):
        if first in why or second in why:
            continue
        side_m = _template_side_m([dump.chips[first], dump.chips[second]], template_m)
        east_m, north_m = np.abs(_plane_m(p_e[first], p_e[second])).tolist()
        share = max(0.0, 1.0 - east_m / side_m) * max(0.0, 1.0 - north_m / side_m)
        if share > SHARED:
            name, apart_m = dump.targets[first].target_id, float(np.hypot(east_m, north_m))
            why[second] = f"it lies {apart_m:.3g} m from target {name} and shares {share:.0%} of its pixels: "
            why[second] += "not independent of it, counted once"
    return why


def _pixel_m(dump: Dump) -> float:
    """Size of a pixel on the ground below the satellite, m."""
    height_m = float(np.median(np.linalg.norm(dump.orbit.positions_m, axis=1))) - WGS84.semi_major_m
    return height_m * dump.line_camera.pixel_rad


def _template_side_m(chips: Sequence[ChipFile], most_m: float) -> float:
    """Side of the smallest template of chips, m; one that cannot be read is reported by its reader."""
    sides_m = [most_m]
    for chip in chips:
        with suppress(RawDataError):
            sides_m.append(grid_place(chip.path, chip.file).side_m)
    return min(sides_m)


def _plane_m(a_e: Floats, b_e: Floats) -> Floats:
    """Displacement (2,) from a to b, m east and north."""
    lat, lon, _ = geodetic_from_ecef(a_e[None], WGS84)
    return np.asarray((local_axes_e(lat, lon)[0].T @ (b_e - a_e))[:2])
