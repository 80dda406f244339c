"""Many frames at once: ragged, at the bound, and as the paper's literal algorithm has each."""

from dataclasses import replace

import numpy as np
import pytest
from drawn_campaigns import BOLD, CAMERAS, R_CS0, assert_chi_square
from scipy.spatial.transform import Rotation
from ten_steps import frame_information_literally

from boresight.features.paper.frames import calibrate_frames, frame_pairs, prepare_frames
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import theta_between
from boresight.geometry.sightings import VectorSets
from boresight.simulator.campaign import draw_frames, noisy_frames


def drawn(n, seed, stars=30, targets=10):
    return draw_frames(n, stars, targets, 0.06, 0.3, CAMERAS, np.random.default_rng(seed))


def cut(frames: VectorSets, stars: list[int], targets: list[int]) -> VectorSets:
    """The frames with only the first so many stars and targets each."""
    s = np.concatenate([np.arange(a, a + n) for a, n in zip(frames.star_start, stars)])
    c = np.concatenate([np.arange(a, a + n) for a, n in zip(frames.target_start, targets)])
    return replace(
        frames,
        star_start=np.concatenate([[0], np.cumsum(stars)]),
        target_start=np.concatenate([[0], np.cumsum(targets)]),
        **{name: getattr(frames, name)[s] for name in ("u_s", "v_stars", "sigma_s")},
        **{name: getattr(frames, name)[c] for name in ("w_c", "v_targets", "sigma_c")},
    )


def test_ragged_frames_give_what_each_gives_alone():
    frames = cut(drawn(6, 1), [30, 2, 0, 17, 1, 25], [10, 3, 4, 0, 5, 1])
    F, F_theta = frame_pairs(prepare_frames(frames), BOLD)
    for k in (0, 1, 5):
        s, c = (np.array([0, len(part)]) for part in (frames.frame(k)[0], frames.frame(k)[3]))
        u_s, v_s, sigma_s, w_c, v_c, sigma_c = frames.frame(k)
        alone = VectorSets(
            star_start=s,
            u_s=u_s,
            v_stars=v_s,
            sigma_s=sigma_s,
            target_start=c,
            w_c=w_c,
            v_targets=v_c,
            sigma_c=sigma_c,
        )
        one_F, one_F_theta = frame_pairs(prepare_frames(alone), BOLD)
        np.testing.assert_allclose(F[k], one_F[0], rtol=0, atol=1e-12 * np.abs(F[k]).max())
        np.testing.assert_allclose(F_theta[k], one_F_theta[0], rtol=0, atol=1e-9 * np.abs(F_theta[k]).max())
    assert not np.any(F[[2, 3, 4]]) and not np.any(F_theta[[2, 3, 4]])  # no stars, no targets, one star


@pytest.mark.parametrize(
    ("stars", "targets", "tolerance_arcsec"),
    # theta is 7 arcsec off about Z in frames of few targets: the forms part at second order in that
    [(30, 10, 1e-4), (60, 20, 1e-4), (12, 4, 5e-3), (40, 3, 5e-3)],
)
def test_information_form_is_the_literal_form(stars, targets, tolerance_arcsec):
    frames = drawn(3, 1, stars, targets)
    R_cs = calibrate_frames(frames, BOLD).R_cs
    F, F_theta = frame_pairs(prepare_frames(frames), R_cs)
    pairs = [frame_information_literally(*frames.frame(k), R_cs) for k in range(3)]
    for k, (literal_F, literal_F_theta) in enumerate(pairs):
        np.testing.assert_allclose(F[k], literal_F, rtol=0, atol=1e-9 * np.abs(literal_F).max())  # relative
        theta, literal = np.linalg.solve(F[k], F_theta[k]), np.linalg.solve(literal_F, literal_F_theta)
        np.testing.assert_allclose(theta, literal, rtol=0, atol=tolerance_arcsec * ARCSEC)
    together = np.linalg.solve(F.sum(axis=0), F_theta.sum(axis=0))
    assert np.linalg.norm(together) < 1e-10  # rad: M = I for one form ...
    literal = np.linalg.solve(*(np.sum(part, axis=0) for part in zip(*pairs)))
    assert np.linalg.norm(literal) < tolerance_arcsec * ARCSEC  # ... is M = I for the other


def test_a_frame_with_one_target_still_counts_in_two_directions():
    F, _ = frame_pairs(prepare_frames(drawn(1, 1, 30, 1)), BOLD)
    values = np.linalg.eigvalsh(F[0])
    assert values[1] > 1e10  # rad^-2: two turns to 10 µrad or better
    assert values[0] < 1e-6 * values[1]  # the third, about the target's direction, not at all


def test_errors_are_at_the_bound_and_unbiased():
    exact = draw_frames(60, 30, 10, 0.06, 0.3, CAMERAS, np.random.default_rng(4), noise=False)
    rng, runs = np.random.default_rng(5), 60
    found = [calibrate_frames(noisy_frames(exact, rng), R_CS0) for _ in range(runs)]
    off = np.array([theta_between(f.R_cs, BOLD) for f in found])
    covariance = found[0].solution.covariance
    nees = np.einsum("ra,ab,rb->", off, np.linalg.inv(covariance), off)
    assert_chi_square(nees, 3 * runs)
    assert np.all(np.abs(off.mean(axis=0)) < 3.3 * np.sqrt(np.diag(covariance) / runs))


def test_a_matrix_far_away_is_reached_and_a_hopeless_one_refused():
    frames = drawn(20, 6)
    far = Rotation.from_rotvec([0.2, -0.1, 0.15]) * BOLD
    assert np.linalg.norm(theta_between(calibrate_frames(frames, far).R_cs, BOLD)) < 5 * ARCSEC
    with pytest.raises(ValueError, match="from the identity after 1 iterations"):
        calibrate_frames(frames, far, most_iterations=1)
