"""Exported attitudes are as dense as their interpolation by others needs."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from boresight.features.exports.quaternions import continuous_quaternions, instants_to_interpolate
from boresight.features.exports.spice_export import on_ticks
from boresight.geometry.attitude import AttitudeTrack, ConstantRate
from boresight.geometry.epoch import Epoch

RATE = np.array([3e-4, -1.06e-3, 2e-4])  # rad/s, of an orbit
LIMIT_PX = 0.003


def track(jitter_rad: float, interpolation: str) -> AttitudeTrack:
    """Attitudes at 10 Hz, each with an error of its own: an expansion about the nearest one jumps."""
    t_s = np.arange(-20, 121) * 0.1
    own = Rotation.from_rotvec(np.random.default_rng(1).normal(size=(len(t_s), 3)) * jitter_rad)
    R_si = own * Rotation.from_rotvec(np.outer(t_s, RATE))
    return AttitudeTrack(t_s, R_si, ConstantRate.fitted(t_s, R_si), interpolation=interpolation)


def by_great_circles(t_s: np.ndarray, R: Rotation, at_s: np.ndarray) -> Rotation:
    return Slerp(t_s, R)(at_s)


def by_components(t_s: np.ndarray, R: Rotation, at_s: np.ndarray) -> Rotation:
    """Quaternions interpolated linearly and normalised, as INTERPOLATION_METHOD LINEAR says."""
    q = continuous_quaternions(R)
    return Rotation.from_quat(np.column_stack([np.interp(at_s, t_s, q[:, k]) for k in range(4)]))


@pytest.mark.parametrize("interpolation", ["taylor", "lagrange"])
@pytest.mark.parametrize(("jitter_rad", "pixel_rad"), [(0.0, 1e-6), (2e-7, 1.27e-5), (1e-6, 2.54e-5)])
@pytest.mark.parametrize("read", [by_great_circles, by_components])
def test_attitudes_between_the_exported_ones_are_those_of_the_track(
    interpolation: str, jitter_rad: float, pixel_rad: float, read
) -> None:
    """10 m and 20 m of Sentinel-2; places of the largest error may be other than the middles of the steps."""
    attitude = track(jitter_rad, interpolation)
    t_s = instants_to_interpolate(attitude, 0.0, 10.0, LIMIT_PX * pixel_rad)
    at_s = np.random.default_rng(2).uniform(0.01, 9.99, 4000)
    _, of_ticks = on_ticks(Epoch.from_utc("2020-08-16T12:02:20"), t_s)
    # beside the middles of the steps, by which these are chosen, a tenth more; ticks of 1 us move a jump
    for given, most in ((t_s, 1.1 * LIMIT_PX), (of_ticks, 1.25 * LIMIT_PX)):
        missed = (read(given, attitude.R_si(given), at_s) * attitude.R_si(at_s).inv()).magnitude()
        assert missed.max() < most * pixel_rad
    # no more of them than needed: without errors the longest steps, and the 100 breaks
    assert len(t_s) < (182 if jitter_rad == 0.0 else 3000)


def test_a_jump_has_an_attitude_on_either_side() -> None:
    attitude = track(1e-6, "taylor")
    ends = attitude.breaks_s[[19, 119]] + [-1e-6, 1e-6]  # nearer to a break than attitudes lie apart
    t_s = instants_to_interpolate(attitude, *ends, 1e-9)
    assert t_s[[0, -1]].tolist() == ends.tolist()
    between = np.diff(t_s)[np.searchsorted(t_s, attitude.breaks_s[20:119]) - 1]
    assert between.max() < 4e-6 and np.diff(t_s).min() > 1e-6
