"""The orbit of a dump: the states of its file, joined to the rotation of the Earth over them."""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from pathlib import Path

import numpy as np

from boresight.geometry.constants import ARCSEC, GM_EARTH
from boresight.geometry.earth_orientation import EarthOrientationTable, bundled_earth_orientation
from boresight.geometry.earth_rotation import EarthRotation
from boresight.geometry.orbit import Orbit
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.dates import n_covered
from boresight.pipeline.files.orbit_file import Ephemeris, joined_segments, read_segments
from boresight.pipeline.files.spice_kernels import SPK, Kernels, is_kernel, read_spk
from boresight.pipeline.files.text_files import read_table
from boresight.pipeline.files.usual_mistakes import find_orbit_fault

__all__ = ["bundled_table", "orbit_of", "read_earth_orientation", "read_orbit", "segment_over"]

# Longest step of an orbit, of a revolution: velocities and positions then still agree to 2 m/s (degree 3).
MOST_REVOLUTION = 0.1


def read_orbit(path: Path, file: str, kernels: Kernels) -> tuple[Ephemeris, ...]:
    """The orbit of an SPK, or the segments of an OEM, by the first bytes of the file."""
    return (read_spk(path, file, kernels),) if is_kernel(path, file, SPK) else read_segments(path, file)


def segment_over(
    segments: tuple[Ephemeris, ...], strips: list[tuple[float, float]], file: str
) -> tuple[Ephemeris, str]:
    """All segments joined or, if they do not follow or cover a strip, the one that covers most; its name."""
    covered = [n_covered(one.t_s, strips) for one in segments]
    if any(covered) and (all_of_them := joined_segments(segments)) is not None:
        return all_of_them, file
    n = covered.index(max(covered))
    return segments[n], file if len(segments) == 1 else f"{file} (segment {n + 1} of {len(segments)})"


@lru_cache(maxsize=1)
def bundled_table() -> EarthOrientationTable:
    """The Earth-orientation table of the installed package, parsed once in each process."""
    return bundled_earth_orientation()


def read_earth_orientation(path: Path, file: str) -> EarthOrientationTable:
    """A mission's own table of Earth orientation; `RawDataError` for fewer than 4 consecutive days."""
    rows = read_table(path, schema.EarthOrientationRow, file)
    columns = np.array([[r.mjd_utc, r.ut1_utc_s, r.x_arcsec, r.y_arcsec] for r in rows], dtype=float)
    mjd, ut1_utc, x, y = columns.reshape(-1, 4).T
    with refusing(file, "mjd_utc", "4 or more consecutive days"):
        return EarthOrientationTable(
            mjd_utc=mjd,
            ut1_utc_s=ut1_utc,
            xp_rad=x * ARCSEC,
            yp_rad=y * ARCSEC,
            dx_rad=np.zeros(len(mjd)),
            dy_rad=np.zeros(len(mjd)),
            source=file,
            mjd_last_measured=float(mjd[-1]) if len(mjd) else np.nan,
        )


def orbit_of(
    ephemeris: Ephemeris, file: str, table: EarthOrientationTable, *, allow_stale_eop: bool
) -> Orbit:
    """The orbit through the states of an ephemeris.

    `RawDataError` for dates without Earth orientation and states that cannot be interpolated.
    """
    t, frame = ephemeris.t_s, ephemeris.frame
    _check_steps(ephemeris, file)
    for begin, end in pairwise((0, *ephemeris.begins, len(t))):
        positions, velocities = ephemeris.positions_m[begin:end], ephemeris.velocities_m_s[begin:end]
        if fault := find_orbit_fault(t[begin:end], positions, velocities, frame):
            if fault.fault.is_of_frame:
                raise RawDataError(file, "REF_FRAME", f"{frame}, but {fault}", "the frame of the states")
            expected = f"{frame} velocities in km/s that are the rate of change of the positions, "
            expected += "and no jumps"
            raise RawDataError(file, f"state {begin + fault.state + 1}", str(fault), expected)
    try:
        earth = EarthRotation.over(
            ephemeris.epoch, float(t[0]), float(t[-1]), table, allow_stale_eop=allow_stale_eop
        )
    except ValueError as error:  # before 1972, or EarthOrientationError
        found = f"{ephemeris.first_time} to {ephemeris.last_time}"
        expected = f"dates within the Earth-orientation table ({error})"
        raise RawDataError(file, "time of the states", found, expected) from error
    with refusing(file, "states", "an orbit that can be interpolated"):
        names = "epoch t_s positions_m velocities_m_s frame method begins".split()
        same = {name: getattr(ephemeris, name) for name in names}
        return Orbit(**same, degree=ephemeris.interpolation_degree, earth=earth)


def _check_steps(ephemeris: Ephemeris, file: str) -> None:
    """`RawDataError` for states too far apart to be interpolated, or compared with their velocities."""
    radius = np.median(np.linalg.norm(ephemeris.positions_m, axis=1))
    longest = MOST_REVOLUTION * 2.0 * np.pi * np.sqrt(radius**3 / GM_EARTH)
    if (step := float(np.median(np.diff(ephemeris.t_s)))) > longest:
        expected = f"at most {longest:.0f} s, {MOST_REVOLUTION:g} of a revolution"
        raise RawDataError(file, "time of the states", f"steps of {step:.0f} s", expected)
