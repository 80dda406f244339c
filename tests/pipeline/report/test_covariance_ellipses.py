"""Ellipses of a covariance: what their captions say, and the axes that are drawn."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from test_drawn_numbers import scales

from boresight.pipeline.report.figures import covariance_ellipses

ARCSEC = np.pi / 648_000.0


def test_captions_say_the_sigmas_and_the_correlation_of_their_axes() -> None:
    sigma = np.array([0.7, 2.5, 11.0])  # arcsec
    correlation = np.array([[1.0, -0.4, 0.15], [-0.4, 1.0, 0.6], [0.15, 0.6, 1.0]])
    covariance = correlation * np.outer(sigma, sigma) * ARCSEC**2
    saved = SimpleNamespace(installation={"covariance_rad2": covariance.tolist()})
    found = covariance_ellipses(saved)  # type: ignore[arg-type]
    for drawing, (a, b) in zip(found, ((0, 1), (0, 2), (1, 2)), strict=True):
        names, first, second, related = re.match(
            r"(\w+): 1σ ([\d.]+)″ and ([\d.]+)″, correlation ([-+\d.]+)\.", drawing.caption
        ).groups()  # type: ignore[union-attr]
        assert names == "XYZ"[a] + "XYZ"[b]
        # four digits are written of a sigma, three decimals of a correlation
        assert [float(first), float(second)] == pytest.approx([sigma[a], sigma[b]], rel=1e-3)
        assert float(related) == pytest.approx(correlation[a, b], abs=5e-4)
        drawn = re.findall(
            r'<path d="M([^"MZm]+)" style="fill:none;stroke:var\(--ink\);stroke-width:1.4', drawing.svg
        )
        to_x, (to_y,) = scales(drawing.svg)
        for ring, sigmas in zip(drawn, (1.0, 2.4477), strict=True):
            x, y = np.array([point.split() for point in ring.split("L")], dtype=float).T
            x, y = to_x(x), to_y(y)
            farthest = sigmas * sigma[[a, b]]  # of the ellipse, at the other's regression
            np.testing.assert_allclose([x.max(), y.max()], farthest, atol=0.01 * farthest.max())
            assert y[x.argmax()] == pytest.approx(correlation[a, b] * farthest[1], abs=0.12 * farthest[1])
