"""Rounding moves no match."""

import numpy as np
import pytest
from rendered_pairs import MTF_AT_NYQUIST, Pair, make_pair
from rounding import assert_unmoved, nudged
from small_strip import texture
from test_changed import dates
from test_locate import MARGIN, SETTINGS

from boresight.gct_match.imaging.views import view_of
from boresight.gct_match.locate import locate
from boresight.gct_match.refine.least_squares import fit_position

SINGLE = 6e-8  # rounding of single precision, in which pictures are worked on


@pytest.mark.parametrize("step", ["fit_position", "locate"])
def test_no_place_of_a_template_is_moved(step):
    picture = texture(np.random.default_rng(1), 700)

    def views(condition, seed):
        draw = np.random.default_rng(4)
        pair = (
            Pair(*dates(3), np.eye(2))
            if condition == "changed"
            else make_pair(picture, draw, size_px=64, margin_px=MARGIN, condition=condition)
        )
        images = [pair.template, pair.window]
        if seed is not None:
            images = [nudged(image, seed, SINGLE).astype(np.float32) for image in images]
        return *(view_of(image, np.ones(image.shape, dtype=bool)) for image in images), pair.offset_px

    def place(case):
        template, window, offset = case
        middle = 0.5 * (np.array(template.grey.shape[::-1]) - 1.0)
        if step == "locate":
            match = locate(template, window, (MARGIN, MARGIN), MARGIN, middle, SETTINGS)
        else:
            match = fit_position(template, window, np.round(offset).astype(int), middle, MTF_AT_NYQUIST)
        return match.xy_px, np.sqrt(np.diag(match.cov_px))

    more = ("changed",) if step == "locate" else ()
    cases = [lambda seed, of=condition: views(of, seed) for condition in ("clean", "affine", *more)]
    assert_unmoved(f"matches, {step}", place, cases)
