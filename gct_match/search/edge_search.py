"""Best positions of a chip in large pictures by its edges, from coarse to fine.

The whole window is searched on the picture's pooled edge field, four pixels to one. Around the best positions
the edges of means over 2 x 2 px are compared, then, around the best of those, the picture's own edges. The
early steps keep many more positions than the last one, at little cost.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from boresight.gct_match.imaging.views import window
from boresight.gct_match.records import Image
from boresight.gct_match.search import edges
from boresight.records.record import Ints, array, record

__all__ = [
    "Positions",
    "SearchPicture",
    "SearchTemplate",
    "best_positions",
    "search_picture",
    "search_template",
]

_POOLED = 4  # pixels of a picture to one of its pooled edge field
_KEPT = 16, 4  # times as many positions as are wanted in the end are looked at in the next finer picture
_REACH = 2  # pixels by which the next finer picture may move a position
_RING = 1  # pixel around them: the outermost edges of a window are those of a cut
_SPARE = _REACH + _RING  # pixels around a position in the next finer picture that are cut out


@record
class SearchPicture:
    """A picture and its edges on the grids that are searched."""

    image: Image = array("H, W", "grey values; NaN where there are none")
    halved: Image = array("2, A, B", "edges of means over 2 x 2 px, H // 4 * 2 rows, 8 bit in parts of FULL")
    pooled: Image = array("2, C, D", "means over 2 x 2 of `halved`, H // 4 rows")


@record
class SearchTemplate:
    """Edges of a template on the grids of three pictures."""

    own: Image = array("2, H, W", "on the picture's grid; H and W are multiples of four")
    halved: Image = array("2, A, B", "of means over 2 x 2 px")
    pooled: Image = array("2, C, D", "means over 2 x 2 of `halved`")


@record
class Positions:
    """Positions of a template's first pixel, best first. Row n of every array refers to the same position."""

    picture: Ints = array("K", "index of the picture")
    xy: Ints = array("K, 2", "column, row; up to half a template outside the picture")
    value: Image = array("K", "correlation of the edges")


def search_picture(image: Image) -> SearchPicture:
    """A picture (H, W) prepared for a search; NaN marks missing pixels."""
    return SearchPicture(image, *edges.coarse_edge_fields(image))


def search_template(image: Image) -> SearchTemplate:
    """A template (h, w) prepared for a search; `ValueError` if a side is not a multiple of four.

    NaN marks missing pixels.
    """
    h, w = image.shape
    if h % _POOLED or w % _POOLED:
        raise ValueError(f"a template's sides must be multiples of {_POOLED}, got {h} x {w}")
    half = edges.edge_field(edges.halved(image))
    return SearchTemplate(edges.edge_field(image), half, np.stack([edges.halved(plane) for plane in half]))


def best_positions(
    template: SearchTemplate,
    pictures: Sequence[SearchPicture],
    boxes: Sequence[tuple[int, int, int, int]],
    count: int,
) -> Positions:
    """The `count` best positions, in all pictures, of a template whose first pixel lies in the box (x0, y0,
    x1, y1), px, of a picture.
    """
    first, second = (times * count for times in _KEPT)
    found = [_cells(template.pooled, p.pooled, box, first) for p, box in zip(pictures, boxes, strict=True)]
    everywhere = Positions(
        np.repeat(np.arange(len(found)), [len(value) for _, value in found]),
        np.concatenate([xy for xy, _ in found]),
        np.concatenate([value for _, value in found]),
    )
    positions = _best(everywhere, first)
    fields = _windows([p.halved for p in pictures], positions, template.halved.shape, 2) / edges.FULL
    positions = _best(_moved(template.halved, fields, positions, 2), second)
    windows = _windows([p.image[None] for p in pictures], positions, (1, *template.own.shape[1:]), 1)
    return _best(_moved(template.own, _edges_of(windows[:, 0]), positions, 1), count)


def _cells(template: Image, field: Image, box: tuple[int, int, int, int], most: int) -> tuple[Ints, Image]:
    """The best cells of the pooled fields, local maxima before any others: (K, 2) pixels of the picture, and
    their correlation (K,), with 1 added to that of a maximum.
    """
    h, w = template.shape[1:]
    rows, columns = field.shape[1:]
    x0, y0 = max(box[0] // _POOLED, -(w // 2)), max(box[1] // _POOLED, -(h // 2))
    x1 = min(-(-box[2] // _POOLED) + w, columns + w // 2)
    y1 = min(-(-box[3] // _POOLED) + h, rows + h // 2)
    if x1 - x0 < w or y1 - y0 < h:
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.float32)
    surface = edges.edge_similarity(template, window(field, x0, y0, x1 - x0, y1 - y0))
    maximum = surface == cv2.dilate(surface, np.ones((3, 3), np.uint8))
    score = (surface + maximum).ravel()
    cells = np.flatnonzero(maximum)
    if len(cells) < most:
        cells = np.arange(len(score))
    if len(cells) > most:
        cells = cells[np.argpartition(score[cells], -most)[-most:]]
    row, column = np.divmod(cells, surface.shape[1])
    return _POOLED * np.column_stack([column + x0, row + y0]), score[cells]


def _windows(planes: Sequence[Image], positions: Positions, shape: tuple[int, ...], scale: int) -> Image:
    """What planes (N, H, W) of the pictures, `scale` px to one, show of a template (N, h, w) at its positions
    and `_SPARE` around: (K, N, h + 2 _SPARE, w + 2 _SPARE). Beyond a picture's edges they show the edge.
    """
    n, h, w = shape[0], shape[1] + 2 * _SPARE, shape[2] + 2 * _SPARE
    out = np.empty((len(positions.xy), n, h, w), dtype=planes[0].dtype)
    for k, plane in enumerate(planes):
        here = np.flatnonzero(positions.picture == k)
        x, y = (positions.xy[here] // scale - _SPARE).T
        inside = (x >= 0) & (y >= 0) & (x <= plane.shape[2] - w) & (y <= plane.shape[1] - h)
        if inside.any():  # a picture may be smaller than the template
            view = np.lib.stride_tricks.sliding_window_view(plane, (n, h, w))[0]
            out[here[inside]] = view[y[inside], x[inside]]
        row = np.clip(y[~inside, None] + np.arange(h), 0, plane.shape[1] - 1)
        column = np.clip(x[~inside, None] + np.arange(w), 0, plane.shape[2] - 1)
        out[here[~inside]] = plane[:, row[:, :, None], column[:, None, :]].swapaxes(0, 1)
    return out


def _edges_of(windows: Image) -> Image:
    """(K, 2, h, w) edges of pictures (K, h, w); in their outermost pixels those of a cut."""
    k, h, w = windows.shape
    return edges.edge_field(windows.reshape(k * h, w)).reshape(2, k, h, w).swapaxes(0, 1)


def _moved(template: Image, fields: Image, positions: Positions, scale: int) -> Positions:
    """Each position moved by up to `_REACH` to where the template (2, h, w) agrees best with the edges there,
    fields (K, 2, h + 2 _SPARE, w + 2 _SPARE) of means over scale² px.
    """
    values = np.ascontiguousarray(fields[:, :, _RING:-_RING, _RING:-_RING]).reshape(len(fields), -1)
    power = 2.0 * np.einsum("kd,kd->k", values, values) / values.shape[1]
    similar = edges.normalised_correlation(values @ _shifted(template).T, template, power[:, None])
    best = similar.argmax(axis=1)
    row, column = np.divmod(best, 2 * _REACH + 1)
    move = np.column_stack([column, row]) - _REACH
    return Positions(positions.picture, positions.xy + scale * move, similar[np.arange(len(best)), best])


def _shifted(template: Image) -> Image:
    """A template (2, h, w) at each position of a field that is `_REACH` wider on every side, one a row."""
    _, h, w = template.shape
    n = 2 * _REACH + 1
    out = np.zeros((n, n, 2, h + n - 1, w + n - 1), dtype=np.float32)
    inner = edges.centred(template)
    for y in range(n):
        for x in range(n):
            out[y, x, :, y : y + h, x : x + w] = inner
    return out.reshape(n * n, -1)


def _best(positions: Positions, count: int) -> Positions:
    """The best, each once."""
    place = np.column_stack([positions.picture, positions.xy[:, ::-1]])
    _, once = np.unique(place, axis=0, return_index=True)
    keep = once[np.argsort(-positions.value[once], kind="stable")[:count]]
    return Positions(positions.picture[keep], positions.xy[keep], positions.value[keep])
