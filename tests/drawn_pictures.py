"""What a picture shows: a file of some size may still be an empty plot."""

import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from PIL import Image

from boresight.pipeline.report.panels import SERIES

FEWEST_PX = 60  # of a line or a few markers; antialiased edges do not count

# Two pictures of one drawing: sides of their blocks, px; difference of a block's mean grey, of 255, that
# rounding does not make; share of blocks that may differ by more, as by a last digit that a label rounds.
BLOCK_PX, GREY_LEVELS, FEW_BLOCKS = 8, 16.0, 0.002

# Of texts that pictures hold. Other processors round sums in another order (test_demo_numbers.py): three
# units of the last digit; of the matrix, of twelve decimals, 1e-4 of its 1-sigma about Z; of covariances,
# which have powers of ten, a thousandth.
NUMBER = re.compile(r"[+\N{MINUS SIGN}-]?\d+(?:\.\d+)?(?:e[+\N{MINUS SIGN}-]\d+)?")
LAST_DIGITS, MATRIX, COVARIANCE = 3.0, 5e-9, 1e-3
SERIES_COLOURS = tuple(colour for colour, *_ in SERIES)


def pixels_of_colour(path: Path, colour: str) -> int:
    """Number of pixels of a PNG file that have a colour, to 2 of 255 levels."""
    with Image.open(path) as image:
        assert image.format == "PNG"
        pixels = np.asarray(image.convert("RGB")).astype(int)
    return int((np.abs(pixels - np.round(255.0 * np.array(to_rgb(colour)))).max(axis=2) <= 2).sum())


def shows_curves(path: Path, *colours: str) -> bool:
    """Whether a plot has curves, bars or markers in each of these colours, beside frame and labels."""
    return all(pixels_of_colour(path, colour) >= FEWEST_PX for colour in colours)


@contextmanager
def kept_figures(*modules: ModuleType) -> Iterator[list[Figure]]:
    """The figures that modules would write, with their numbers; the files are written as well."""
    kept: list[Figure] = []
    with pytest.MonkeyPatch.context() as patch:
        for module in modules:
            write = module.write_figure

            def keep(path: Path, figure: Figure, write: Callable[..., None] = write, **more: int) -> None:
                kept.append(figure)
                write(path, figure, **more)

            patch.setattr(module, "write_figure", keep)
        yield kept


def numbers(text: str) -> list[float]:
    """All numbers of a line, in order."""
    return [float(one) for one in re.findall(r"[-+]?(?:\d+\.?\d*(?:e[-+]?\d+)?|nan\b)", text)]


def same_picture(one: Image.Image, other: Image.Image) -> bool:
    """Whether two pictures show the same, but for rounding: of one size, and alike in nearly all blocks."""
    if one.size != other.size:
        return False
    a, b = (_blocks(np.asarray(picture.convert("L")).astype(float)) for picture in (one, other))
    return bool((np.abs(a - b) > GREY_LEVELS).mean() <= FEW_BLOCKS)


def _blocks(grey: np.ndarray) -> np.ndarray:
    """Mean grey values of blocks; a last part of a block is left out."""
    rows, columns = (n // BLOCK_PX for n in grey.shape)
    whole = grey[: rows * BLOCK_PX, : columns * BLOCK_PX]
    return whole.reshape(rows, BLOCK_PX, columns, BLOCK_PX).mean(axis=(1, 3))


def assert_alike(kept: str, now: str, name: str) -> None:
    """The same words, wherever lines end, and numbers that differ by rounding alone."""
    words = ["".join(NUMBER.sub("#", text).split()) for text in (kept, now)]
    assert words[0] == words[1], name
    for (a, allowed), (b, _) in zip(_with_limits(kept), _with_limits(now), strict=True):
        assert abs(a - b) <= allowed * (1 + 1e-9), f"{name}: {a}, now {b}"


def _with_limits(text: str) -> list[tuple[float, float]]:
    """Numbers of a text, each with the difference that is allowed."""
    found = []
    for shown in NUMBER.findall(text):
        mantissa, has_power, _ = shown.partition("e")
        value = float(shown.replace("\N{MINUS SIGN}", "-"))
        unit = 10.0 ** -len(mantissa.partition(".")[2])
        found.append((value, COVARIANCE * abs(value) if has_power else max(LAST_DIGITS * unit, MATRIX)))
    return found
