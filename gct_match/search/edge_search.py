"""A chip's best places in large pictures, by its edges: from coarse to fine.

A picture is held at one scale. On its pooled edge field, four pixels to one, the whole window is searched;
around the best places edges of the picture's means over 2 x 2 px are compared, then, around the best of
those, the picture's own. What is far too many places for the last step costs little in the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from boresight.gct_match.imaging.views import window
from boresight.gct_match.search.edges import (
    FULL,
    centred,
    coarse_edge_fields,
    edge_field,
    edge_similarity,
    halved,
    normalised,
)

__all__ = ["Places", "SearchPicture", "SearchTemplate", "best_places", "search_picture", "search_template"]

Image = NDArray[Any]  # whole numbers or single precision

_POOLED = 4  # pixels of a picture to one of its pooled edge field
_KEPT = 16, 4  # times as many places as are wanted in the end are looked at in the next finer picture
_REACH = 2  # pixels by which the next finer picture may move a place
_RING = 1  # pixel around them: the outermost edges of a window are those of a cut
_SPARE = _REACH + _RING


@dataclass(frozen=True, slots=True, eq=False)
class SearchPicture:
    """A picture and its edges on the grid that is searched."""

    image: Image  # (H, W)
    halved: Image  # (2, H // 4 * 2, W // 4 * 2) edges of means over 2 x 2 px, 8 bit
    pooled: Image  # (2, H // 4, W // 4) their means over 2 x 2


@dataclass(frozen=True, slots=True, eq=False)
class SearchTemplate:
    """A template's edges on the grids of three pictures."""

    own: Image  # (2, h, w), h and w multiples of four
    halved: Image  # (2, h / 2, w / 2)
    pooled: Image  # (2, h / 4, w / 4)


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Where a template's first pixel may lie, best first. Row n of every array speaks of the same place."""

    picture: NDArray[np.int64]  # (K,) index into the pictures
    xy: NDArray[np.int64]  # (K, 2) column, row; up to half a template outside
    value: Image  # (K,) correlation of the edges


def search_picture(image: Image) -> SearchPicture:
    """A picture (H, W) made ready for a search; NaN where it shows nothing."""
    return SearchPicture(image, *coarse_edge_fields(image))


def search_template(image: Image) -> SearchTemplate:
    """A template (h, w) made ready for a search; NaN where it shows nothing."""
    h, w = image.shape
    if h % _POOLED or w % _POOLED:
        raise ValueError(f"a template's sides must be multiples of {_POOLED}, got {h} x {w}")
    half = edge_field(halved(image))
    return SearchTemplate(edge_field(image), half, np.stack([halved(plane) for plane in half]))


def best_places(
    template: SearchTemplate,
    pictures: Sequence[SearchPicture],
    boxes: Sequence[tuple[int, int, int, int]],
    count: int,
) -> Places:
    """The best places of a template whose first pixel lies within a box (x0, y0, x1, y1) of each picture."""
    first, second = (times * count for times in _KEPT)
    found = [_cells(template.pooled, p.pooled, box, first) for p, box in zip(pictures, boxes, strict=True)]
    everywhere = Places(
        np.repeat(np.arange(len(found)), [len(value) for _, value in found]),
        np.concatenate([xy for xy, _ in found]),
        np.concatenate([value for _, value in found]),
    )
    places = _best(everywhere, first)
    fields = _windows([p.halved for p in pictures], places, template.halved.shape, 2) / FULL
    places = _best(_moved(template.halved, fields, places, 2), second)
    windows = _windows([p.image[None] for p in pictures], places, (1, *template.own.shape[1:]), 1)
    return _best(_moved(template.own, _edges_of(windows[:, 0]), places, 1), count)


def _cells(
    template: Image, field: Image, box: tuple[int, int, int, int], most: int
) -> tuple[NDArray[np.int64], Image]:
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
    surface = edge_similarity(template, window(field, x0, y0, x1 - x0, y1 - y0))
    maximum = surface == cv2.dilate(surface, np.ones((3, 3), np.uint8))
    score = (surface + maximum).ravel()
    cells = np.flatnonzero(maximum)
    if len(cells) < most:
        cells = np.arange(len(score))
    if len(cells) > most:
        cells = cells[np.argpartition(score[cells], -most)[-most:]]
    row, column = np.divmod(cells, surface.shape[1])
    return _POOLED * np.column_stack([column + x0, row + y0]), score[cells]


def _windows(planes: Sequence[Image], places: Places, shape: tuple[int, ...], scale: int) -> Image:
    """What planes (N, H, W) of the pictures, `scale` px to one, show of a template (N, h, w) at its places
    and `_SPARE` around: (K, N, h + 2 _SPARE, w + 2 _SPARE). Beyond a picture's edges they show the edge.
    """
    n, h, w = shape[0], shape[1] + 2 * _SPARE, shape[2] + 2 * _SPARE
    out = np.empty((len(places.xy), n, h, w), dtype=planes[0].dtype)
    for k, plane in enumerate(planes):
        here = np.flatnonzero(places.picture == k)
        x, y = (places.xy[here] // scale - _SPARE).T
        inside = (x >= 0) & (y >= 0) & (x <= plane.shape[2] - w) & (y <= plane.shape[1] - h)
        view = np.lib.stride_tricks.sliding_window_view(plane, (n, h, w))[0]
        out[here[inside]] = view[y[inside], x[inside]]
        row = np.clip(y[~inside, None] + np.arange(h), 0, plane.shape[1] - 1)
        column = np.clip(x[~inside, None] + np.arange(w), 0, plane.shape[2] - 1)
        out[here[~inside]] = plane[:, row[:, :, None], column[:, None, :]].swapaxes(0, 1)
    return out


def _edges_of(windows: Image) -> Image:
    """(K, 2, h, w) edges of pictures (K, h, w); in their outermost pixels those of a cut."""
    k, h, w = windows.shape
    return edge_field(windows.reshape(k * h, w)).reshape(2, k, h, w).swapaxes(0, 1)


def _moved(template: Image, fields: Image, places: Places, scale: int) -> Places:
    """Each place moved by up to `_REACH` to where the template (2, h, w) agrees best with the edges there,
    fields (K, 2, h + 2 _SPARE, w + 2 _SPARE) of means over scale² px.
    """
    values = np.ascontiguousarray(fields[:, :, _RING:-_RING, _RING:-_RING]).reshape(len(fields), -1)
    power = 2.0 * np.einsum("kd,kd->k", values, values) / values.shape[1]
    similar = normalised(values @ _shifted(template).T, template, power[:, None])
    best = similar.argmax(axis=1)
    row, column = np.divmod(best, 2 * _REACH + 1)
    move = np.column_stack([column, row]) - _REACH
    return Places(places.picture, places.xy + scale * move, similar[np.arange(len(best)), best])


def _shifted(template: Image) -> Image:
    """A template (2, h, w) at each place of a field that is `_REACH` wider on every side, one a row."""
    _, h, w = template.shape
    n = 2 * _REACH + 1
    out = np.zeros((n, n, 2, h + n - 1, w + n - 1), dtype=np.float32)
    inner = centred(template)
    for y in range(n):
        for x in range(n):
            out[y, x, :, y : y + h, x : x + w] = inner
    return out.reshape(n * n, -1)


def _best(places: Places, count: int) -> Places:
    """The best, each once."""
    number = (places.picture << 50) + (places.xy[:, 1] << 25) + places.xy[:, 0]
    _, once = np.unique(number, return_index=True)
    keep = once[np.argsort(-places.value[once], kind="stable")[:count]]
    return Places(places.picture[keep], places.xy[keep], places.value[keep])
