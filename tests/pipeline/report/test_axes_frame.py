"""Frames of axes: the same labels at the same places as Matplotlib's own."""

from __future__ import annotations

import io
import re

import matplotlib
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from boresight.pipeline.report.axes_frame import LABEL_PT, NAME_PT, FrameColours, frame_svg
from boresight.pipeline.report.drawing import axes_of, drawn, dress_axes, new_figure

TEXT = re.compile(r'text-anchor: (\w+)[^>]*?x="([-\d.]+)" y="([-\d.]+)"[^>]*>([^<]*)<')


def texts(svg: str) -> list[tuple[str, str, float, float]]:
    """Text, anchor and place (x, y), points, of each line of text, in order."""
    return sorted((text, anchor, float(x), float(y)) for anchor, x, y, text in TEXT.findall(svg))


def own_texts(figure: Figure) -> list[tuple[str, str, float, float]]:
    """The same as Matplotlib draws them."""
    out = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figure.savefig(out, format="svg")
    return texts(out.getvalue())


def plain(axes: Axes) -> None:
    axes.plot([0.0, 17.3], [-0.61, 0.44])


def logarithmic(axes: Axes) -> None:
    axes.plot([3.0, 250.0], [1.0, 8.0])
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter("{x:g}")


def downwards(axes: Axes) -> None:
    axes.set_xlim(-0.5, 1023.5)
    axes.set_ylim(767.5, -0.5)
    axes.set_aspect("equal")


@pytest.mark.parametrize("content", [plain, logarithmic, downwards])
def test_labels_and_names_lie_where_matplotlib_would_draw_them(content) -> None:
    figure = new_figure(2.6)
    axes = figure.add_subplot()
    axes.set_xlabel("sample, px", fontsize=NAME_PT)
    axes.set_ylabel("rms & more, m", fontsize=NAME_PT)
    axes.tick_params(which="both", labelsize=LABEL_PT)
    content(axes)
    expected = own_texts(figure)
    found = texts("".join(frame_svg(figure, axes, FrameColours("#111111", "#222222", "#333333"))))
    assert [one[:2] for one in found] == [one[:2] for one in expected]
    for one, other in zip(found, expected):
        assert one[2:] == pytest.approx(other[2:], abs=0.3)  # points: a third of a pixel of the screen


def test_hidden_labels_are_not_written_and_hidden_axes_have_no_frame() -> None:
    figure = new_figure(3.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes in (upper, lower):
        dress_axes(axes, "", "m")
        axes.plot([0.0, 4.0], [0.0, 0.5])
    upper.set_visible(False)
    assert [one[0] for one in texts(drawn(figure, "one", "", "").svg) if one[1] == "middle"].count("2.0") == 1
    upper.set_visible(True)
    both = texts(drawn(figure, "both", "", "").svg)
    assert [one[0] for one in both if one[1] == "middle"].count("2.0") == 1  # below the lower one alone
    assert [one[0] for one in both if one[1] == "end"].count("0.2") == 2


def test_an_offset_of_labels_is_written() -> None:
    figure = new_figure(2.6)
    axes = axes_of(figure, "", "")
    axes.plot([0.0, 1.0], [1e-7, 3e-7])
    assert any(text == "1e−7" for text, *_ in texts(drawn(figure, "small", "", "").svg))
