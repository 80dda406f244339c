"""The alignment between two heads against the one that was drawn."""

from dataclasses import replace
from types import SimpleNamespace as Of

import numpy as np
import pytest
from drawn_campaigns import assert_chi_square, squared
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from two_trackers import ARCSEC, NOISE, R_SH, T, tracks

from boresight.features.heads.alignment import _terms, align_heads
from boresight.pipeline.head_noise.tracks import HeadTrack


def test_alignment_and_its_covariance_hold() -> None:
    nees, runs = 0.0, 30
    for seed in range(runs):
        found = align_heads(
            *tracks(np.random.default_rng(100 + seed)), (NOISE[0], NOISE[1]), {"hour": T / 3600}, 10.0
        )
        error = (found.R_sh * R_SH.inv()).as_rotvec()
        nees += squared(error, found.covariance_s)
        assert abs(found.angle_rad - np.arccos(R_SH.apply([0, 0, 1])[2])) < 6.0 * found.sigma_angle_rad
        drift = found.terms[0]
        assert np.all(np.abs(drift.value) < 5.0 * drift.sigma)
    assert_chi_square(nees, 3 * runs)


def test_time_offset_shows_when_the_satellite_slews() -> None:
    late = 0.012  # s
    noise = (NOISE[0], NOISE[1])
    slewing = align_heads(*tracks(np.random.default_rng(7), late, slew_rad_s2=1e-4), noise, {}, 10.0)
    assert abs(slewing.time_offset_s - late) < 4.0 * slewing.sigma_time_offset_s < 0.004
    steady = align_heads(*tracks(np.random.default_rng(7), late), noise, {}, 10.0)
    assert steady.sigma_time_offset_s > 0.05


def test_alignment_terms_and_errors_are_those_of_least_squares_with_the_covariance_of_every_row() -> None:
    """Means over 1 s weighted with the covariance of all rows by the formula of `AttitudeNoise`, each row by
    itself, and with the rate of the drawn motion; one head's record has a gap, the noise has all its parts.
    """
    slew, constant_s, axis = 1e-4, 31.0, np.array([0.6, -0.5, 0.62])
    of_noise = (
        ([1.0, 2.0, 3.0], [50.0, 30.0, 40.0], [2.0, 0.3, 0.6], [3.0, 0.5, 1.0], 41.0, 2),
        ([4.0, 2.5, 1.5], [35.0, 50.0, 45.0], [0.2, 1.5, 0.8], [0.4, 2.0, 3.5], 23.0, 1),
    )
    noise = [
        replace(
            one,
            correlated_rad=np.array(correlated) * ARCSEC,
            correlation_time_s=np.array(tau_ms) / 1e3,
            constant_rad=np.array(constant) * ARCSEC,
            periodic_rad=np.array(periodic) * ARCSEC,
            period_s=period_s,
            harmonics=harmonics,
        )
        for one, (correlated, tau_ms, constant, periodic, period_s, harmonics) in zip(NOISE, of_noise)
    ]

    def motion(t: np.ndarray) -> Rotation:
        return Rotation.from_rotvec(np.outer(0.5 * slew * t**2, axis)) * Rotation.from_rotvec(
            np.outer(t, [0.0, 1.1e-3, 0.0])
        )

    kept = np.r_[0:303, 308:930]
    t = T[kept] + 7.3
    drift = Rotation.from_rotvec(np.outer(np.cos(0.1 * t), [12.0, -23.0, 35.0]) * ARCSEC)
    R_hi = R_SH.inv() * drift.inv() * motion(t - 0.012)
    one = HeadTrack(name="A", t_s=T + 1007.3, R_hi=motion(T + 7.3), R_oi=motion(T + 7.3))
    two = HeadTrack(name="B", t_s=t + 1000.0, R_hi=R_hi, R_oi=motion(t))
    terms = {"degree": 20.0 + np.cos(0.1 * t), "wave": 3.0 * np.sin(0.27 * t), "one more": np.cos(0.4 * t)}
    found = align_heads(one, two, (noise[0], noise[1]), terms, constant_s)

    second = np.floor(t - t[0] + 1e-9).astype(int)
    mean = (second == np.arange(93)[:, None]) / np.bincount(second)[:, None]
    apart = t[:, None] - t
    middle = mean @ t
    number = (middle - middle[0]) // constant_s
    piece = np.equal.outer(number, number)
    C = np.zeros((93, 3, 93, 3))
    for head, axes in zip(noise, (np.eye(3), R_SH.as_matrix())):
        for n in range(3):
            rows = head.white_rad[n] ** 2 * np.eye(len(t))
            rows += head.correlated_rad[n] ** 2 * np.exp(-np.abs(apart) / head.correlation_time_s[n])
            blocks = mean @ rows @ mean.T + head.constant_rad[n] ** 2 * piece
            phase = 2.0 * np.pi * np.subtract.outer(middle, middle) / head.period_s
            waves = sum(np.cos(h * phase) for h in range(1, head.harmonics + 1)) / head.harmonics
            blocks += head.periodic_rad[n] ** 2 * waves
            C += np.einsum("bc,x,y->bxcy", blocks, axes[:, n], axes[:, n])
    C = C.reshape(279, 279)
    slewed = Rotation.from_rotvec(np.outer(0.5 * slew * t**2, axis))
    rate = np.outer(slew * t, axis) + slewed.apply([0.0, 1.1e-3, 0.0])
    rho = (one.R_hi[kept] * two.R_hi.inv() * R_SH.inv()).as_rotvec()
    columns = [np.ones((93, 1, 1)) * np.eye(3), (mean @ (rate - (mean @ rate).mean(axis=0)))[:, :, None]]
    columns += [(mean @ v - (mean @ v).mean())[:, None, None] * np.eye(3) for v in terms.values()]
    X = np.concatenate(columns, axis=2).reshape(279, 13)
    covariance = np.linalg.inv(X.T @ np.linalg.solve(C, X))
    best = covariance @ X.T @ np.linalg.solve(C, (mean @ rho).ravel())
    sigma = np.sqrt(np.diag(covariance))

    values = [(found.R_sh * R_SH.inv()).as_rotvec(), [found.time_offset_s], *(u.value for u in found.terms)]
    errors = [np.sqrt(np.diag(found.covariance_s)), [found.sigma_time_offset_s]]
    errors += [u.sigma for u in found.terms]
    assert found.n_rows == 925 and [u.name for u in found.terms] == ["degree", "wave", "one more"]
    # parts of sigma: what the mean of a process of some 40 ms leaves out, and the rate over a second
    assert np.abs((np.concatenate(values) - best) / sigma).max() < 0.02
    assert_allclose(np.concatenate(errors), sigma, rtol=0.01)
    assert_allclose(found.covariance_s, covariance[:3, :3], atol=0.01 * np.min(sigma[:3] ** 2))
    assert_allclose(found.block_sigma.ravel(), np.sqrt(np.diag(C)), rtol=0.03)
    assert_allclose(found.block_t_s, middle + 1000.0, atol=1e-9)  # s: rounding
    assert_allclose(found.block_s, mean @ rho - best[:3], atol=0.02 * sigma[:3].min())
    turned = (Rotation.from_rotvec(1e-6 * np.eye(3)) * found.R_sh).apply([0.0, 0.0, 1.0])[:, 2]
    gradient = (np.arccos(turned) - found.angle_rad) / 1e-6
    # a difference over 1 urad of an angle of about a radian
    assert_allclose(found.sigma_angle_rad**2, gradient @ found.covariance_s @ gradient, rtol=1e-4)


def test_three_common_instants_have_an_alignment_and_two_have_none() -> None:
    noise = (NOISE[0], NOISE[1])

    def aligned(rows: int) -> Rotation:
        one, two = (
            replace(track, t_s=T[:rows], R_hi=track.R_hi[:rows], R_oi=track.R_oi[:rows])
            for track in tracks(np.random.default_rng(3))
        )
        return align_heads(one, two, noise, {}, 10.0).R_sh

    # within six times the largest error of one attitude, some 13 arcsec
    assert (aligned(3) * R_SH.inv()).magnitude() < 80.0 * ARCSEC
    with pytest.raises(ValueError, match="2 instants with attitudes of A and B, 3 are needed"):
        aligned(2)


@pytest.mark.parametrize(("orbits", "warmer_c"), [(0.2, 0.0), (0.3, 2.0), (0.2, 2.0), (1.4, 0.05)])
def test_terms_of_an_alignment_are_those_that_the_record_spans_enough_of(
    orbits: float, warmer_c: float
) -> None:
    t = np.linspace(100.0, 100.0 + 5700.0 * orbits, 300)
    u = 2.0 * np.pi * t / 5700.0 + 1.9  # from the ascending node of a circular orbit
    turned = Rotation.from_euler("xz", [1.7, 0.8])
    states = tuple(turned.apply(np.stack([x, y, 0.0 * t], axis=1)) for x, y in circle(u))
    dump = Of(orbit=Of(states_i=lambda t_s: states))
    temperature = 20.0 + warmer_c * np.linspace(0.0, 1.0, 300) ** 2
    found = _terms(dump, Of(t_s=t), temperature)
    expected = {"hour": t / 3600.0}
    if orbits > 0.25:
        expected |= {
            f"{name}(argument of latitude)": of(u) for name, of in (("cos", np.cos), ("sin", np.sin))
        }
    if warmer_c > 0.1:
        expected["degree Celsius"] = temperature
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert_allclose(found[name], values, atol=1e-9)  # rounding
    assert "degree Celsius" not in _terms(dump, Of(t_s=t), None)


def circle(u: np.ndarray) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Place and velocity in the plane of the orbit, m and m/s."""
    return (7e6 * np.cos(u), 7e6 * np.sin(u)), (-7.5e3 * np.sin(u), 7.5e3 * np.cos(u))
