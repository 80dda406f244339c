"""The paper's literal algorithm, and the information form held to it."""

import numpy as np
import pytest
from drawn_campaigns import BOLD
from ten_steps import frame_information_literally

from boresight.features.paper.frames import calibrate_frames, frame_pairs, prepare_frames
from boresight.geometry.constants import ARCSEC
from boresight.simulator.campaign import CameraPair, draw_frames


def frames_of(n_frames, stars, targets, seed=1, R_cs=BOLD, sigma_c_px=0.3):
    cameras = CameraPair(R_cs)
    return draw_frames(n_frames, stars, targets, 0.06, sigma_c_px, cameras, np.random.default_rng(seed))


@pytest.mark.parametrize(
    ("stars", "targets", "tolerance_arcsec"),
    [
        (30, 10, 1e-4),
        (60, 20, 1e-4),
        (
            12,
            4,
            5e-3,
        ),  # theta is 7 arcsec off about Z in such a frame: the forms part at second order in that
        (40, 3, 5e-3),
    ],
)
def test_information_form_is_the_literal_form(stars, targets, tolerance_arcsec):
    frames = frames_of(3, stars, targets)
    R_cs = calibrate_frames(frames, BOLD).R_cs
    F, F_theta = frame_pairs(prepare_frames(frames), R_cs)
    for k in range(3):
        literal_F, literal_F_theta = frame_information_literally(*frames.frame(k), R_cs)
        np.testing.assert_allclose(F[k], literal_F, rtol=0, atol=1e-9 * np.abs(literal_F).max())  # relative
        theta, literal = np.linalg.solve(F[k], F_theta[k]), np.linalg.solve(literal_F, literal_F_theta)
        np.testing.assert_allclose(theta, literal, rtol=0, atol=tolerance_arcsec * ARCSEC)
    together = np.linalg.solve(F.sum(axis=0), F_theta.sum(axis=0))
    assert np.linalg.norm(together) < 1e-10  # rad: M = I for one form ...
    pairs = [frame_information_literally(*frames.frame(k), R_cs) for k in range(3)]
    literal = np.linalg.solve(sum(p[0] for p in pairs), sum(p[1] for p in pairs))
    assert np.linalg.norm(literal) < tolerance_arcsec * ARCSEC  # ... is M = I for the other


def test_a_frame_with_one_target_still_counts_in_two_directions():
    frames = frames_of(1, 30, 1)
    F, _ = frame_pairs(prepare_frames(frames), BOLD)
    values = np.linalg.eigvalsh(F[0])
    assert values[1] > 1e10  # rad^-2: two turns to 10 µrad or better
    assert values[0] < 1e-6 * values[1]  # the third, about the target's direction, not at all
