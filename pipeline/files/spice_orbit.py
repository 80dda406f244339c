"""Read the orbit of a dump from a SPICE ephemeris kernel (SPK): states relative to the Earth, axes of ICRF.

An SPK of any type is evaluated by NAIF's toolkit at equal steps over every interval that it covers, ends
included.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from boresight.geometry.ephemeris_time import seconds_from_ephemeris_time
from boresight.geometry.epoch import Epoch
from boresight.geometry.record import Floats
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.orbit_file import Ephemeris, check_components, check_states
from boresight.pipeline.files.spice_kernels import Kernels, loaded, toolkit

__all__ = ["read_spk"]

EARTH = 399  # NAIF's id
# Steps, s, of which the smallest with at most MAX_STATES states is taken. Of 60 s the interpolation below
# errs by less than 1e-6 m in a low orbit.
STEPS_S = (1.0, 2.0, 5.0, 10.0, 30.0, 60.0)
MAX_STATES = 100_000  # of an orbit: a day at 1 s
DEGREE = 9  # of Hermite's interpolation


def read_spk(path: Path, file: str, kernels: Kernels) -> Ephemeris:
    """States of the satellite of `kernels`, or of the only object in the SPK; `file` names it in errors.

    Raises `RawDataError`.
    """
    spice = toolkit(file)
    with loaded(path, file, kernels) as spk:
        body = _body(spice, spk, kernels, file)
        et = _instants(_cover(spice, spk, body), file)
        states = np.array([spice.spkgeo(body, one, "J2000", EARTH)[0] for one in et.tolist()])
    states = states.reshape(-1, 6)
    check_components(states, file)
    values = 1e3 * states
    epoch = Epoch(int(np.floor(seconds_from_ephemeris_time(Epoch(0), et[:1])[0])))
    t_s = seconds_from_ephemeris_time(epoch, et)
    check_states(t_s, values[:, :3], values[:, 3:], file)
    first, last = epoch.utc_from_seconds([float(t_s[0]), float(t_s[-1])])
    return Ephemeris(
        epoch=epoch,
        t_s=t_s,
        positions_m=values[:, :3],
        velocities_m_s=values[:, 3:],
        frame="GCRF",
        method="hermite",
        interpolation_degree=DEGREE,
        first_time=first,
        last_time=last,
    )


def _body(spice: Any, spk: str, kernels: Kernels, file: str) -> int:
    """NAIF's id of the satellite."""
    bodies = sorted(int(one) for one in spice.spkobj(spk))
    if kernels.spacecraft is None and len(bodies) == 1:
        return bodies[0]
    if kernels.spacecraft in bodies:
        return int(kernels.spacecraft)
    expected = "one object, or `spacecraft = ID` of one of them under [spice] in dump.toml"
    if kernels.spacecraft is not None:
        expected = f"{kernels.spacecraft}, the spacecraft under [spice] in dump.toml"
    raise RawDataError(file, "objects", ", ".join(map(str, bodies[:16])), expected)


def _cover(spice: Any, spk: str, body: int) -> Floats:
    """Begin and end (N, 2), ephemeris time, of the intervals that the SPK covers."""
    cover = spice.spkcov(spk, body)
    return np.array([spice.wnfetd(cover, n) for n in range(spice.wncard(cover))]).reshape(-1, 2)


def _instants(cover: Floats, file: str) -> Floats:
    """Ephemeris times (N,), increasing, at equal steps over each interval, ends included."""
    lengths = cover[:, 1] - cover[:, 0]
    if not np.isfinite(lengths).all() or (longest := lengths.sum()) > MAX_STATES * STEPS_S[-1]:
        days = f"{lengths.sum() / 86_400.0:.0f} days"
        expected = f"at most {MAX_STATES * STEPS_S[-1] / 86_400.0:.0f} days; cut it with NAIF's `spkmerge`"
        raise RawDataError(file, "cover", days, expected)
    step = next(one for one in STEPS_S if longest <= MAX_STATES * one)
    parts = [
        np.linspace(begin, end, int(np.ceil((end - begin) / step)) + 1) for begin, end in cover if end > begin
    ]
    return np.unique(np.concatenate([np.zeros(0), *parts]))
