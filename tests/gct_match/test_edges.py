"""Edges that are found again whatever the crop: directions count, which side is brighter does not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from gct_match.correlation import peaks_of
from gct_match.edges import edge_field, edge_similarity


def parcels(rng: np.random.Generator, tones: NDArray) -> NDArray:
    """A mosaic of 150 x 150 px whose parcels have the given tones, with noise."""
    seeds = np.random.default_rng(8).uniform(0.0, 150.0, (len(tones), 2))
    y, x = np.mgrid[0:150, 0:150]
    nearest = np.hypot(x[..., None] - seeds[:, 0], y[..., None] - seeds[:, 1]).argmin(axis=2)
    mosaic = cv2.GaussianBlur(tones[nearest].astype(np.float32), (0, 0), 0.7)
    return (mosaic + rng.normal(0.0, 1.5, mosaic.shape)).astype(np.float32)


def everywhere(image: NDArray) -> NDArray:
    return np.ones(image.shape, dtype=bool)


def test_negative_has_the_same_edges(invented: NDArray):
    image = invented[:120, :160]
    field = edge_field(image, everywhere(image))
    assert edge_field(255.0 - image, everywhere(image)) == pytest.approx(field, abs=1e-4)
    assert np.hypot(*field).max() <= 1.0


def test_parcels_are_found_again_when_all_crops_have_changed():
    rng = np.random.default_rng(3)
    one, two = (parcels(rng, rng.uniform(40.0, 200.0, 60)) for _ in range(2))
    chip = one[70:110, 30:70]
    surface = edge_similarity(edge_field(chip, everywhere(chip)), edge_field(two, everywhere(two)))
    assert peaks_of(surface, 1, 3).xy[0] == pytest.approx([30.0, 70.0], abs=0.6)  # px
    grey = cv2.matchTemplate(two, chip, cv2.TM_CCOEFF_NORMED)
    assert peaks_of(grey, 1, 3).xy[0] != pytest.approx(
        [30.0, 70.0], abs=0.6
    )  # grey values alone do not find it


def test_clouds_have_no_edges(invented: NDArray):
    image, valid = invented[:80, :80].copy(), np.ones((80, 80), dtype=bool)
    valid[20:40, 30:60] = False
    image[~valid] = 255.0
    field = edge_field(image, valid)
    assert not field[:, 19:41, 29:61].any()
    assert field[:, :18].any()
