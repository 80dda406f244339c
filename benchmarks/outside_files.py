"""Files of other projects given to the readers: what is read, and what is refused with which words?

    python benchmarks/outside_files.py WORK > benchmarks/results/outside_files.txt

WORK/index.csv has a line for each file: `file` (its place below WORK), `family` (orbit, attitude, dimap or
points), `origin` (repository and path there) and `image` (of points in several images, else empty). The files
are not in this repository; those of public repositories are found by their origin. An orbit that is read is
compared with the library `oem`, where that reads it; the states must also be an orbit that can be used.
"""

from __future__ import annotations

import argparse
import csv
import sys
import warnings
from collections import Counter
from pathlib import Path

import numpy as np
from oem import OrbitEphemerisMessage
from record import exit_status, head, verdict

from boresight.features.operators.point_import import PointErrors, read_measured_points
from boresight.geometry.epoch import Epoch
from boresight.geometry.inertial_frames import of_date_to_gcrs, rotation_to_gcrs
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.attitude_files import read_attitudes
from boresight.pipeline.files.dimap_metadata import operator_model
from boresight.pipeline.files.orbit_and_earth import bundled_table, orbit_of
from boresight.pipeline.files.orbit_file import OF_DATE, Ephemeris, read_segments

FAMILIES = ("orbit", "attitude", "dimap", "points")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("work", type=Path)
    work = parser.parse_args().work
    sys.argv[1:] = ["WORK"]  # what the record says
    warnings.simplefilter("ignore")
    head("Files of other projects given to the readers")
    with (work / "index.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    counts: Counter[tuple[str, str]] = Counter()
    for family in FAMILIES:
        print(family)
        for row in (row for row in rows if row["family"] == family):
            kind, text = outcome(work / row["file"], family, row["image"] or None)
            counts[family, kind] += 1
            print(f"  {row['origin']}: {kind}, {text}")
        print()
    for family in FAMILIES:
        print(f"{family:10s}{counts[family, 'read']:5d} read{counts[family, 'refused']:5d} refused")
    tracebacks = sum(number for (_, kind), number in counts.items() if kind == "TRACEBACK")
    verdict(f"0 tracebacks ({tracebacks})", tracebacks == 0)
    raise SystemExit(exit_status())


def outcome(path: Path, family: str, image: str | None) -> tuple[str, str]:
    """ "read", "refused" or "TRACEBACK", and details."""
    try:
        if family == "orbit":
            return "read", orbit(path)
        if family == "attitude":
            rows = read_attitudes(path, path.name, Epoch(0), None, None)
            return "read", f"{len(rows.t_s)} attitudes"
        if family == "dimap":
            strip = operator_model(path)
            return "read", f"{strip.width_px} x {strip.height_px} px"
        height_m = 0.0 if path.suffix == ".points" else None
        errors = PointErrors(sigma_px=0.5, sigma_m=(1.0, 1.0, 1.0), height_m=height_m)
        return "read", f"{len(read_measured_points(path, errors, image).names)} points"
    except RawDataError as error:
        return "refused", str(error).replace(str(path), path.name)
    except Exception as error:
        return "TRACEBACK", f"{type(error).__name__}: {error}"


def orbit(path: Path) -> str:
    """What was read; `RawDataError` where it is no orbit to be used."""
    segments = read_segments(path, path.name)
    for one in segments:
        orbit_of(one, path.name, bundled_table(), allow_stale_eop=True)
    states = " + ".join(str(len(one.t_s)) for one in segments)
    return f"{states} states, {against_library(path, segments)}"


def against_library(path: Path, segments: tuple[Ephemeris, ...]) -> str:
    try:
        others = OrbitEphemerisMessage.open(path).segments
    except Exception as error:
        return f"`oem` refuses it: {error}"
    worst_m = 0.0
    for own, other in zip(segments, others, strict=True):
        positions = 1e3 * np.array([state.position for state in other.states])
        frame = other.metadata["REF_FRAME"].upper()
        if frame in ("EME2000", "J2000"):
            positions = rotation_to_gcrs("EME2000").apply(positions)
        if frame in OF_DATE:
            positions = of_date_to_gcrs(OF_DATE[frame], own.epoch, own.t_s).apply(positions)
        worst_m = max(worst_m, float(np.abs(positions - own.positions_m).max()))
    return f"{worst_m:.1e} m from those of `oem`"


if __name__ == "__main__":
    main()
