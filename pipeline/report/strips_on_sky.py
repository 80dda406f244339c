"""Strips of the sky as the page shows them where a map of the ground would be: their stars on the sky."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.font_manager import FontProperties
from matplotlib.textpath import text_to_path

from boresight.geometry.constants import ARCSEC
from boresight.geometry.record import Floats
from boresight.pipeline.files.table_files import list_values
from boresight.pipeline.report.drawing import INK, MUTED, Drawing, Spot, drawn, dress_axes, new_figure
from boresight.pipeline.report.labels import line_boxes, mark_boxes, place_labels
from boresight.pipeline.report.observations import SeenCard
from boresight.pipeline.report.saved import Saved
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.star_names import star_name

__all__ = ["strips_on_sky"]

MOST_STRIPS = 8  # each has a panel
PANEL_IN, NARROW_PANEL_IN = 3.1, 2.4  # its height: of one alone, and of one of two beside each other
FEWEST_STARS = 4  # that tell how the camera's axes lie on the sky
LONGEST = 0.15  # of the panel's width: the arrow of the largest residual
MOST_NAMES = 12  # of a panel: of its brightest stars
NAME_PT, MARK_PT, LINE_PT = 7.0, 3.6, 1.5  # size of a name; half a mark and half a line, with clear space


def strips_on_sky(saved: Saved, rows: Sequence[SeenCard]) -> Drawing | None:
    """The stars of each strip on the tangent plane of its middle, north up and east to the left, with their
    residuals and the direction in which the camera scanned; None without strips of the sky.
    """
    strips = sorted({row.strip_id for row in rows})[:MOST_STRIPS]
    if not strips:
        return None
    deep = -(-len(strips) // 2)
    figure = new_figure((PANEL_IN if len(strips) == 1 else NARROW_PANEL_IN) * deep, legend_in=0.25)
    panels = figure.subplots(deep, 1 if len(strips) == 1 else 2, squeeze=False).ravel()
    figure.subplots_adjust(hspace=0.45, wspace=0.55)
    residual = [np.hypot(*_residual(saved, row.row)) for row in rows if row.state == "used"]
    largest = float(max(residual, default=0.0)) or 1.0
    spots = []
    for axes, strip in zip(panels, strips):
        spots += _panel(saved, axes, strip, [row for row in rows if row.strip_id == strip], largest)
    for axes in panels[len(strips) :]:
        axes.set_visible(False)
    counts = ", ".join(f"{strip} {sum(r.strip_id == strip for r in rows)} stars" for strip in strips)
    more = len({row.strip_id for row in rows}) - len(strips)
    counts += f" and {more} more strips" if more else ""
    text = f"Strips on the sky, north up and east to the left: {counts}."
    caption = (
        f"{text} Lines: residuals, the longest of those used {largest:.2f}″. Arrow: later lines of the image."
        " Names: of the brightest, where there is room."
    )
    return drawn(figure, "strips-on-sky", caption, text, spots)


def _panel(saved: Saved, axes: Axes, strip: str, rows: Sequence[SeenCard], largest: float) -> list[Spot]:
    """Draws one strip; the marks of its stars."""
    index = np.array([row.row for row in rows])
    u_i = list_values(saved.targets, "u_i", 3)[index]
    place, (ra, dec) = _tangents(u_i)
    reach = 1.3 * float(np.abs(place).max()) + 0.02
    dress_axes(axes, "east, °", "north, °")
    axes.set_title(f"{strip}\nRA {ra:.2f}°, Dec {dec:+.2f}°", fontsize=9, color=INK)
    axes.set(xlim=(reach, -reach), ylim=(-reach, reach), aspect="equal")
    ends: list[Floats] = [np.zeros((0, 2, 2))]
    if (turned := _axes_on_sky(saved, index, place)) is not None:
        to_sky, scan = turned
        off = np.array([_residual(saved, row.row) for row in rows]) @ to_sky.T
        off *= 2.0 * reach * LONGEST / largest
        used = np.array([row.state == "used" for row in rows])
        ends.append(np.stack([place, place + off], axis=1)[used])
        for (x, y), (to_x, to_y) in ends[-1]:
            axes.plot([x, to_x], [y, to_y], color=MUTED, linewidth=1.2)
        middle, half = np.array([-0.82, -0.82]) * reach, 0.15 * reach * scan
        ends.append(np.array([[middle - half, middle + half]]))
        start, end = (tuple(at) for at in ends[-1][0].tolist())
        axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": INK})
    _write_names(axes, [row.target_id for row in rows], place, np.concatenate(ends))
    return [Spot.of(row, axes, x, y) for row, (x, y) in zip(rows, place.tolist())]


def _write_names(axes: Axes, stars: Sequence[str], place: Floats, lines: Floats) -> None:
    """The names of the brightest stars ("HIP 42") at `place` (N, 2), clear of all marks and of `lines`
    (M, 2, 2) from one end to the other, in the axes' units.
    """
    axes.apply_aspect()  # before it, a place in the picture is not known
    per_point = axes.figure.dpi / 72.0
    marks, ends = (axes.transData.transform(at.reshape(-1, 2)) / per_point for at in (place, lines))
    taken = [mark_boxes(marks, MARK_PT), line_boxes(ends[::2], ends[1::2], LINE_PT)]
    known = hipparcos_stars().places
    v_mag = dict(zip(known.hip.tolist(), known.v_mag.tolist()))
    hip = {n: int(star.split()[1]) for n, star in enumerate(stars) if star.startswith("HIP ")}
    once = {number: n for n, number in reversed(hip.items())}  # of a star in two CCDs the first mark
    order = sorted(once, key=lambda number: v_mag.get(number, np.inf))[:MOST_NAMES]
    names = [star_name(number) for number in order]
    font = FontProperties(size=NAME_PT)
    sizes = [text_to_path.get_text_width_height_descent(name, font, False)[0] for name in names]
    boxes = np.array([(width + LINE_PT, 1.2 * NAME_PT) for width in sizes]).reshape(-1, 2)
    frame = np.concatenate(axes.bbox.get_points() / per_point)
    at = place_labels(marks[[once[number] for number in order]], boxes, MARK_PT, frame, np.vstack(taken))
    to_axes = axes.transAxes.inverted()
    for name, (x, y) in zip(names, to_axes.transform(at * per_point).tolist()):
        if np.isfinite(x):
            axes.text(x, y, name, size=NAME_PT, ha="center", va="center", transform=axes.transAxes, color=INK)


def _residual(saved: Saved, row: int) -> Floats:
    """(2,) along x and y of the camera, arcsec."""
    return np.array(saved.targets.column("residual_c")[row].as_py()) / ARCSEC


def _tangents(u_i: Floats) -> tuple[Floats, Floats]:
    """Degrees east and north (N, 2) of directions (N, 3) from their middle, and its right ascension and
    declination, degrees.
    """
    z = u_i.mean(axis=0)
    z /= np.linalg.norm(z)
    east = np.cross([0.0, 0.0, 1.0], z)
    east /= np.linalg.norm(east)
    on_plane = np.column_stack([u_i @ east, u_i @ np.cross(z, east)]) / (u_i @ z)[:, None]
    middle = np.degrees([np.arctan2(z[1], z[0]) % (2.0 * np.pi), np.arcsin(z[2])])
    return np.degrees(on_plane), middle


def _axes_on_sky(saved: Saved, index: np.ndarray, place: Floats) -> tuple[Floats, Floats] | None:
    """(2, 2) from x, y of the camera to east, north, and the unit vector (2,) in which later lines look;
    None with too few stars.
    """
    if len(index) < FEWEST_STARS:
        return None
    u_c, line = list_values(saved.targets, "u_c", 3)[index], list_values(saved.targets, "xy_px", 2)[index, 1]
    tangent = np.degrees(u_c[:, :2] / u_c[:, 2:])
    span = max(float(np.ptp(line)), 1.0)
    design = np.column_stack([np.ones(len(line)), tangent, (line - line.mean()) / span])
    _, _, y, scan = np.linalg.lstsq(design, place, rcond=1e-6)[0]
    size, length = np.linalg.norm(y), np.linalg.norm(scan)
    if not 0.5 < size < 2.0 or not length:
        return None
    y = y / size
    return np.column_stack([[y[1], -y[0]], y]), scan / length
