import numpy as np
import pytest

from boresight.geometry.line_camera import gaussian_sigma_px


@pytest.mark.parametrize("mtf", [0.08, 0.15, 0.4])
def test_the_gaussian_sampled_finely_has_the_stated_transfer_at_nyquist(mtf: float) -> None:
    x = np.arange(-40.0, 40.0, 0.01)
    spread = np.exp(-0.5 * (x / gaussian_sigma_px(mtf)) ** 2)
    transfer = np.sum(spread * np.cos(np.pi * x)) / np.sum(spread)  # half a cycle a pixel
    assert transfer == pytest.approx(mtf, rel=1e-6)  # what is left is the sum in steps of 0.01 px
