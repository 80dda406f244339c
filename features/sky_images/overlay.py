"""The picture of `boresight identify --overlay`: an image of the sky with what is in it named.

Rings: identified stars with name and V magnitude, larger the brighter; squares: other detections; crosses:
detections of no star's shape; diamonds: planets. Labels cover neither each other nor a mark nor a line; only
those of bright stars rather cover marks of faint ones than be left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from boresight.features.sky_images.identify_images import misshapen_in
from boresight.features.sky_images.planets import Planet
from boresight.pipeline.report.marks import mark_boxes, place_labels
from boresight.pipeline.report.star_preview import sky_stretch
from boresight.records.record import Floats, array, record, scalar
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import FieldSolution
from boresight.star_id.star_names import star_name

__all__ = ["named_sky"]

Colour = tuple[int, int, int]
LEAST_PX = 960  # a picture whose longer side is shorter is enlarged, so that labels have room
# Height of the letters over the image's longer side, and the smallest that is readable, px.
LETTERS, SMALLEST_LETTERS_PX = 0.011, 11
# Radius of a star's ring in letters: at magnitude 0, less for each magnitude, and the smallest.
RING, RING_OF_MAGNITUDE, SMALLEST_RING = 1.3, 0.11, 0.5
OTHER = 0.35  # half a mark of the other kinds, in letters; a planet's is twice that
BRIGHTNESS = 0.75  # of the image's white, so that marks and labels stand out
WHITE, GREY = (255, 250, 225), (185, 192, 200)
BRIGHT = 4.0  # to this magnitude a star gets its label even if that covers marks of fainter ones
SMALLER = 0.85  # letters of stars that have no name but a number
_SHIFT = 4  # of OpenCV's whole numbers: sixteenths of a pixel
_TURN = np.linspace(0.0, 2.0 * np.pi, 49)


@record
class _Kind:
    """A kind of mark."""

    sign: str = scalar("in the key")
    words: str = scalar("in the key")
    colour: Colour = scalar("RGB")
    strokes: tuple[Floats, ...] = scalar("polygons (K, 2) in halves of the mark")


@record
class _Marks:
    """The marks of one kind."""

    kind: _Kind = scalar("their kind")
    xy_px: Floats = array("N, 2", "(column, row)")
    half_px: Floats = array("N", "half a mark")


@record
class _Label:
    """Words beside a point."""

    words: str = scalar("the words")
    colour: Colour = scalar("RGB")
    xy_px: Floats = array("2", "(column, row)")
    gap_px: float = scalar("from the point to the words")
    letters_px: int = scalar("height of the letters")
    bright: bool = scalar("whether it may cover marks of faint stars")


_STAR = _Kind("○", "stars named", (90, 235, 140), (np.column_stack([np.cos(_TURN), np.sin(_TURN)]),))
_DETECTION = _Kind(
    "□", "other detections", (225, 140, 45), (np.array([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1)]),)
)
_NO_STAR = _Kind("×", "no star", (255, 90, 90), (np.array([(-1, -1), (1, 1)]), np.array([(-1, 1), (1, -1)])))
_PLANET = _Kind("◇", "planets", (225, 150, 255), (np.array([(1, 0), (0, 1), (-1, 0), (0, -1), (1, 0)]),))


def named_sky(image: NDArray[Any], found: FieldSolution, planets: Sequence[Planet]) -> NDArray[np.uint8]:
    """The image (H, W) as RGB (H, W, 3) with marks and labels, of its own size; a small one enlarged by a
    whole number. A mirror image must be reversed already.
    """
    larger = -(-LEAST_PX // max(image.shape))
    letters = max(SMALLEST_LETTERS_PX, round(LETTERS * larger * max(image.shape)))
    thick = max(1, round(letters / 11))
    v_mag = _magnitudes(found.hip)
    assert found.stars is not None  # `solve_list` gives it
    others = np.delete(found.stars.xy_px, found.detections, axis=0)
    no_stars = misshapen_in(image, found.stars)
    at_planets = np.array([(p.x_px, p.y_px) for p in planets]).reshape(-1, 2)
    rings = letters * np.maximum(RING - RING_OF_MAGNITUDE * v_mag, SMALLEST_RING)
    half = OTHER * letters
    marks = (  # those of identified stars first
        _Marks(_STAR, _enlarged(found.xy_px, larger), rings),
        _Marks(_DETECTION, _enlarged(others, larger), np.full(len(others), half)),
        _Marks(_NO_STAR, _enlarged(no_stars, larger), np.full(len(no_stars), half)),
        _Marks(_PLANET, _enlarged(at_planets, larger), np.full(len(at_planets), 2.0 * half)),
    )
    grey = 255.0 * BRIGHTNESS * sky_stretch(image.astype(np.float32))
    whole = grey.astype(np.uint8).repeat(larger, axis=0).repeat(larger, axis=1)
    picture = np.repeat(whole[:, :, None], 3, axis=2)
    for one in marks:
        for stroke in one.kind.strokes:
            at = one.xy_px[:, None] + one.half_px[:, None, None] * stroke
            _draw(picture, at, one.kind.colour, thick)
    taken = [mark_boxes(one.xy_px, one.half_px) for one in marks]
    labels = _labels(found.hip, v_mag, marks, planets, letters)
    return _written(picture, labels, np.vstack(taken), marks, letters)


def _magnitudes(hip: NDArray[np.integer]) -> Floats:
    """V (N,) of stars of the catalogue."""
    places = hipparcos_stars().places
    return np.asarray(places.v_mag[np.searchsorted(places.hip, hip)])


def _enlarged(xy_px: Floats, larger: int) -> Floats:
    """Places in the image as places in the picture; (0, 0) is the middle of the first pixel of both."""
    return (xy_px + 0.5) * larger - 0.5


def _labels(
    hip: NDArray[np.integer], v_mag: Floats, marks: Sequence[_Marks], planets: Sequence[Planet], letters: int
) -> list[_Label]:
    """What is to be written, the most important first: planets, stars by brightness."""
    stars, space = marks[0], 0.2 * letters
    labels = []
    for planet, at, half in zip(planets, marks[-1].xy_px, marks[-1].half_px):
        labels.append(_Label(planet.name, _PLANET.colour, at, float(half) + space, letters, True))
    small = max(SMALLEST_LETTERS_PX, round(SMALLER * letters))
    for n in np.argsort(v_mag, kind="stable"):
        name, gap = star_name(int(hip[n])), float(stars.half_px[n]) + space
        colour, height = (GREY, small) if name.startswith("HIP ") else (WHITE, letters)
        words, bright = f"{name} {v_mag[n]:.1f}", bool(v_mag[n] < BRIGHT)
        labels.append(_Label(words, colour, stars.xy_px[n], gap, height, bright))
    return labels


def _draw(picture: NDArray[np.uint8], lines: Floats, colour: Colour, thick: int) -> None:
    """Lines (N, K, 2) through K points each, (column, row) in px."""
    whole = np.rint(lines * 2**_SHIFT).astype(np.int32)
    cv2.polylines(picture, list(whole), False, colour, thick, cv2.LINE_AA, _SHIFT)


def _written(
    picture: NDArray[np.uint8], labels: Sequence[_Label], taken: Floats, marks: Sequence[_Marks], letters: int
) -> NDArray[np.uint8]:
    """The picture with a key in its corner and the labels that find room."""
    height, width = picture.shape[:2]
    whole = Image.fromarray(picture)
    pen = ImageDraw.Draw(whole)
    edge = max(1, round(letters / 7))

    def write(x: float, y: float, words: str, colour: Colour, font: ImageFont.FreeTypeFont) -> None:
        pen.text((x, y), words, colour, font, "lm", stroke_width=edge, stroke_fill=(0, 0, 0))

    font = _font(letters)
    x, y = float(letters), height - 1.2 * letters
    words = [f"{one.kind.sign} {len(one.xy_px)} {one.kind.words}" for one in marks]
    ends = x + np.cumsum([(font.getlength(text) + 1.5 * letters) * (" 0 " not in text) for text in words])
    key = np.array([[0.0, y - letters, ends[-1], height]])
    pen.rectangle(tuple(key[0].tolist()), (0, 0, 0))
    for one, text, end in zip(marks, words, ends.tolist()):
        if len(one.xy_px):
            write(x, y, text, one.kind.colour, font)
        x = end
    sizes = np.array(
        [(_font(one.letters_px).getlength(one.words) + 2 * edge, 1.2 * letters) for one in labels]
    )
    bright = [one.xy_px for one in labels if one.bright]
    must_not = np.vstack([key, mark_boxes(np.array(bright).reshape(-1, 2), letters)])
    frame = np.array([0.0, 0.0, width, height])
    centres = _centres(labels, sizes, frame, np.vstack([taken, key]), must_not)
    for label, size, centre in zip(labels, sizes, centres):
        if np.isfinite(centre[0]):
            start = centre[0] - 0.5 * size[0] + edge
            write(start, centre[1], label.words, label.colour, _font(label.letters_px))
    return np.asarray(whole)


def _centres(
    labels: Sequence[_Label], sizes: Floats, frame: Floats, taken: Floats, must_not: Floats
) -> Floats:
    """Centres (N, 2) of labels, NaN where there is no room: clear of the boxes `taken`, or, of a bright star
    that finds no such place, of those that it `must_not` cover.
    """
    at, gaps = np.array([one.xy_px for one in labels]), np.array([one.gap_px for one in labels])
    centres = np.full((len(labels), 2), np.nan)
    bright = np.array([one.bright for one in labels])
    for some, obstacles in ((bright, taken), (bright, must_not), (~bright, taken)):
        rows = np.flatnonzero(some & np.isnan(centres[:, 0]))
        done = np.isfinite(centres[:, 0])
        written = np.hstack([(centres - 0.5 * sizes)[done], (centres + 0.5 * sizes)[done]])
        centres[rows] = place_labels(
            at[rows], sizes[rows], gaps[rows], frame, np.vstack([obstacles, written])
        )
    return centres


@lru_cache(maxsize=4)
def _font(letters_px: int) -> ImageFont.FreeTypeFont:
    """The font that Matplotlib brings along."""
    file = Path(matplotlib.get_data_path(), "fonts", "ttf", "DejaVuSans.ttf")
    return ImageFont.truetype(str(file), letters_px)
