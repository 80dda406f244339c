"""Strips of the sky as the page shows them where a map of the ground would be: their stars on the sky."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.table_files import list_values
from boresight.pipeline.report.drawing import MUTED, Axis, Drawing, Figure, Panel, Pen, Spot, drawn
from boresight.pipeline.report.marks import line_boxes, mark_boxes, place_labels
from boresight.pipeline.report.observations import SeenCard
from boresight.pipeline.report.saved import Saved
from boresight.records.record import Floats
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.star_names import star_name

__all__ = ["strips_on_sky"]

MOST_STRIPS = 8  # each has a panel
PANEL_IN, NARROW_PANEL_IN = 3.1, 2.4  # its height: of one alone, and of one of two beside each other
FEWEST_STARS = 4  # that tell how the camera's axes lie on the sky
LONGEST = 0.15  # of the panel's width: the arrow of the largest residual
MOST_NAMES = 12  # of a panel: of its brightest stars
TITLE_PT, GAPS_PT = 25.0, (66.0, 70.0)  # room above a panel, and between two
LETTER = 0.62  # width of a letter, in heights of its font: no font of a page has wider ones on average
NAME_PT, MARK_PT, LINE_PT = 7.0, 3.6, 1.5  # size of a name; half a mark and half a line, with clear space


def strips_on_sky(saved: Saved, rows: Sequence[SeenCard]) -> Drawing | None:
    """The stars of each strip on the tangent plane of its middle, north up and east to the left, with their
    residuals and the direction in which the camera scanned; None without strips of the sky.
    """
    strips = sorted({row.strip_id for row in rows})[:MOST_STRIPS]
    if not strips:
        return None
    deep = -(-len(strips) // 2)
    figure = Figure((PANEL_IN if len(strips) == 1 else NARROW_PANEL_IN) * deep, above=TITLE_PT)
    residual = [np.hypot(*_residual(saved, row.row)) for row in rows if row.state == "used"]
    largest = float(max(residual, default=0.0)) or 1.0
    spots = []
    for n, strip in enumerate(strips):
        cell = figure.cell(n, deep, min(len(strips), 2), GAPS_PT)
        spots += _panel(saved, figure, cell, strip, [row for row in rows if row.strip_id == strip], largest)
    counts = ", ".join(f"{strip} {sum(r.strip_id == strip for r in rows)} stars" for strip in strips)
    more = len({row.strip_id for row in rows}) - len(strips)
    counts += f" and {more} more strips" if more else ""
    text = f"Strips on the sky, north up and east to the left: {counts}."
    caption = (
        f"{text} Lines: residuals, the longest of those used {largest:.2f}″. Arrow: later lines of the image."
        " Names: of the brightest, where there is room."
    )
    return drawn(figure, "strips-on-sky", caption, text, spots)


def _panel(
    saved: Saved, figure: Figure, cell: Sequence[float], strip: str, rows: Sequence[SeenCard], largest: float
) -> list[Spot]:
    """Draws one strip; the marks of its stars."""
    index = np.array([row.row for row in rows])
    u_i = list_values(saved.targets, "u_i", 3)[index]
    place, (ra, dec) = _tangents(u_i)
    reach = 1.3 * float(np.abs(place).max()) + 0.02
    axes = figure.panel(Axis("east, °", reach, -reach), Axis("north, °", -reach, reach), cell, aspect=1.0)
    axes.title(strip, f"RA {ra:.2f}°, Dec {dec:+.2f}°")
    ends: list[Floats] = [np.zeros((0, 2, 2))]
    if (turned := _axes_on_sky(saved, index, place)) is not None:
        to_sky, scan = turned
        off = np.array([_residual(saved, row.row) for row in rows]) @ to_sky.T
        off *= 2.0 * reach * LONGEST / largest
        used = np.array([row.state == "used" for row in rows])
        ends.append(np.stack([place, place + off], axis=1)[used])
        for x, y in np.swapaxes(ends[-1], 1, 2):
            axes.line(x, y, Pen(colour=MUTED, width=1.2))
        middle, half = np.array([-0.82, -0.82]) * reach, 0.15 * reach * scan
        ends.append(np.array([[middle - half, middle + half]]))
        axes.arrows(*np.swapaxes(ends[-1], 0, 1))
    _write_names(axes, [row.target_id for row in rows], place, np.concatenate(ends))
    return [Spot.of(row, axes, x, y) for row, (x, y) in zip(rows, place.tolist())]


def _write_names(axes: Panel, stars: Sequence[str], place: Floats, lines: Floats) -> None:
    """The names of the brightest stars ("HIP 42") at `place` (N, 2), clear of all marks and of `lines`
    (M, 2, 2) from one end to the other, in the axes' units.
    """
    marks, ends = (axes.at(*at.reshape(-1, 2).T) for at in (place, lines))
    taken = [mark_boxes(marks, MARK_PT), line_boxes(ends[::2], ends[1::2], LINE_PT)]
    known = hipparcos_stars().places
    v_mag = dict(zip(known.hip.tolist(), known.v_mag.tolist()))
    hip = {n: int(star.split()[1]) for n, star in enumerate(stars) if star.startswith("HIP ")}
    once = {number: n for n, number in reversed(hip.items())}  # of a star in two CCDs the first mark
    order = sorted(once, key=lambda number: v_mag.get(number, np.inf))[:MOST_NAMES]
    names = [star_name(number) for number in order]
    boxes = np.array([(LETTER * NAME_PT * len(name), 1.2 * NAME_PT) for name in names]).reshape(-1, 2)
    frame = np.array(axes.box)[[0, 2, 1, 3]]
    at = place_labels(marks[[once[number] for number in order]], boxes, MARK_PT, frame, np.vstack(taken))
    for name, (x, y) in zip(names, at.tolist()):
        if np.isfinite(x):
            axes.figure.text(x, y + 0.35 * NAME_PT, name, NAME_PT)


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
