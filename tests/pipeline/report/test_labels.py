"""Labels beside marks."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from boresight.pipeline.report.marks import line_boxes, mark_boxes, place_labels

FRAME = np.array([0.0, 0.0, 100.0, 60.0])
NOTHING = np.zeros((0, 4))


@settings(deadline=None)  # machines may be busy
@given(st.integers(0, 2**32 - 1), st.integers(0, 60))
def test_no_label_covers_a_label_a_mark_or_a_line_or_leaves_the_picture(seed, count):
    rng = np.random.default_rng(seed)
    points, sizes = rng.uniform((0, 0), (100, 60), (count, 2)), rng.uniform((5, 3), (30, 5), (count, 2))
    lines = rng.uniform((0, 0), (100, 60), (2, 3, 2))
    taken = np.vstack([mark_boxes(points, 1.0), line_boxes(*lines, 0.5)])
    centres = place_labels(points, sizes, 1.0, FRAME, taken)
    good = np.isfinite(centres[:, 0])
    low, high = (centres - 0.5 * sizes)[good], (centres + 0.5 * sizes)[good]
    assert (low >= FRAME[:2]).all() and (high <= FRAME[2:]).all()
    boxes = np.vstack([np.column_stack([low, high]), taken])
    for n, box in enumerate(boxes[: len(low)]):
        width = np.minimum(box[2:], boxes[:, 2:]) - np.maximum(box[:2], boxes[:, :2])
        shared = (np.delete(width, n, axis=0) > 1e-9).all(axis=1)  # rounding of sums of 100 in float64
        assert not shared.any()
    along = lines[0][:, None] + np.linspace(0, 1, 201)[:, None] * (lines[1] - lines[0])[:, None]
    for corner, far in zip(low, high):
        assert not ((along > corner) & (along < far)).all(axis=-1).any()


def test_a_lone_label_stands_right_of_its_mark_and_one_without_room_is_left_out():
    point, size = np.array([[50.0, 30.0]]), np.array([[20.0, 4.0]])
    assert place_labels(point, size, 1.0, FRAME, NOTHING).tolist() == [[61.0, 30.0]]
    near_edge = np.array([[90.0, 30.0]])
    assert place_labels(near_edge, size, 1.0, FRAME, NOTHING).tolist() == [[79.0, 30.0]]
    assert np.isnan(place_labels(point, size, 1.0, FRAME, FRAME[None])).all()
