"""Edges that are found again whatever the crop: directions count, which side is brighter does not."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from boresight.gct_match.search.correlation import peaks_of
from boresight.gct_match.search.edges import FULL, coarse_edge_fields, edge_field, edge_similarity, halved


def parcels(rng: np.random.Generator, tones: NDArray) -> NDArray:
    """A mosaic of 150 x 150 px whose parcels have the given tones, with noise."""
    seeds = np.random.default_rng(8).uniform(0.0, 150.0, (len(tones), 2))
    y, x = np.mgrid[0:150, 0:150]
    nearest = np.hypot(x[..., None] - seeds[:, 0], y[..., None] - seeds[:, 1]).argmin(axis=2)
    mosaic = cv2.GaussianBlur(tones[nearest].astype(np.float32), (0, 0), 0.7)
    return (mosaic + rng.normal(0.0, 1.5, mosaic.shape)).astype(np.float32)


def test_negative_has_the_same_edges(invented: NDArray):
    image = invented[:120, :160]
    field = edge_field(image)
    assert edge_field(255.0 - image) == pytest.approx(field, abs=1e-4)
    assert np.hypot(*field).max() <= 1.0


def test_parcels_are_found_again_when_all_crops_have_changed():
    rng = np.random.default_rng(3)
    one, two = (parcels(rng, rng.uniform(40.0, 200.0, 60)) for _ in range(2))
    chip = one[70:110, 30:70]
    surface = edge_similarity(edge_field(chip), edge_field(two))
    assert peaks_of(surface, 1, 3).xy[0] == pytest.approx([30.0, 70.0], abs=0.6)  # px
    grey = cv2.matchTemplate(two, chip, cv2.TM_CCOEFF_NORMED)
    assert peaks_of(grey, 1, 3).xy[0] != pytest.approx(
        [30.0, 70.0], abs=0.6
    )  # grey values alone do not find it


def test_clouds_have_no_edges(invented: NDArray):
    image = invented[:80, :80].astype(np.float32)
    image[20:40, 30:60] = np.nan
    field = edge_field(image)
    assert np.isfinite(field).all()
    assert not field[:, 19:41, 29:61].any()
    assert field[:, :18].any()


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_coarse_fields_in_bands_are_those_of_the_whole(invented: NDArray, kind: type):
    # The median comes from strips of rows: 5 % of it move no |z| by more than 0.0125; 8 bit cut off 1/127.
    image = np.tile(invented[:160, :150], (4, 1)).astype(kind)
    fine, pooled = coarse_edge_fields(image)
    whole = edge_field(halved(image[:, :148]))
    assert fine.shape == whole.shape == (2, 320, 74)
    assert np.abs(fine / FULL - whole).max() < 1 / 127 + 0.0125
    assert np.abs(pooled - np.stack([halved(plane) for plane in whole])).max() < 0.0125


def test_ground_full_of_edges_is_no_likelier():
    # Noise of the template's power beside a faint copy of it: products alone would favour the noise.
    rng = np.random.default_rng(6)
    template = rng.normal(0.0, 0.3, (2, 8, 8)).astype(np.float32)
    field = np.concatenate([rng.normal(0.0, 1.0, (2, 40, 40)), np.zeros((2, 40, 40))], axis=2)
    field[:, 20:28, 56:64] = 0.5 * template
    surface = edge_similarity(template, field.astype(np.float32))
    row, column = np.unravel_index(surface.argmax(), surface.shape)
    assert (row, column) == (20, 56)
    mean = template.mean(axis=(1, 2))
    assert surface.max() == pytest.approx(1.0 - mean @ mean / (2.0 * np.mean(template**2)), abs=1e-5)


def test_a_template_without_edges_is_like_nothing():
    empty, field = np.zeros((2, 20, 20), dtype=np.float32), np.zeros((2, 60, 60), dtype=np.float32)
    with np.errstate(all="raise"):
        assert (edge_similarity(empty, field) == 0.0).all()
