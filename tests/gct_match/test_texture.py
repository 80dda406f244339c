"""How precisely a picture's texture can fix its position, at best."""

import numpy as np

from boresight.gct_match.texture import expected_sigma_px


def test_stripes_fix_a_position_across_them_only() -> None:
    # A wave of 20 grey values along the columns, noise of 2: 0.01 px across the stripes, nothing along them.
    rng = np.random.default_rng(8)
    x, y = np.meshgrid(np.arange(64.0), np.arange(64.0))
    every = np.ones((64, 64), dtype=bool)
    noise = rng.normal(0.0, 2.0, (64, 64))
    stripes = (100.0 + 20.0 * np.sin(0.6 * x) + noise).astype(np.float32)
    checked = (100.0 + 20.0 * np.sin(0.6 * x) * np.sin(0.6 * y) + noise).astype(np.float32)
    assert expected_sigma_px(checked, every) < 0.03
    assert expected_sigma_px(stripes, every) > 0.5
