"""Plots of a report, each a function from the saved files to a `Drawing`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.table_files import column, list_values
from boresight.pipeline.report.drawing import (
    AXES,
    DASHED,
    FILL,
    MUTED,
    WIDTH_IN,
    Axis,
    Drawing,
    Figure,
    Panel,
    Pen,
    Spot,
    drawn,
)
from boresight.pipeline.report.observations import ExposureCard, SeenCard, TargetCard
from boresight.pipeline.report.page_template import utc_text
from boresight.pipeline.report.saved import Saved
from boresight.records.ledger import State
from boresight.records.record import Floats

__all__ = [
    "allan_plot",
    "angle_histogram",
    "angle_spread",
    "attitudes_in_time",
    "ccd_means",
    "convergence",
    "covariance_ellipses",
    "exposure_chi2",
    "ground_scatter",
    "residual_panels",
    "squared_residual_histogram",
    "star_residual_map",
    "star_residual_panels",
]

CELLS = 14  # of the star map along its longer side
# Fewest stars of a cell of the detector whose mean residual is drawn.
FEWEST_IN_CELL = 5
FILLED = Pen(colour=MUTED, fill=FILL, width=0.8)
ELLIPSE_SIGMAS = (1.0, 2.4477)  # 39 and 95 per cent of a plane normal distribution


def convergence(saved: Saved) -> Drawing:
    """1-sigma of theta and distance of theta from its final value after each further strip, arcsec."""
    table = saved.convergence
    frames = column(table, "frames")
    theta, sigma = (list_values(table, name, 3) / ARCSEC for name in ("theta_rad", "sigma_rad"))
    distance = np.abs(theta[:-1] - theta[-1:])
    figure = Figure(3.0, above=25.0)
    both = Axis.over("arc-seconds", np.concatenate([sigma, distance]), is_log=True)
    axes = figure.panel(Axis.over("star exposures so far", frames), both)
    for n, curve in enumerate(AXES):
        seen = np.isfinite(sigma[:, n])
        pen = Pen(colour=curve.colour, dash=curve.dash, width=1.6)
        axes.line(frames[seen], sigma[seen, n], pen, f"{curve.name}: 1σ")
        if seen.sum() == 1:  # one point makes no line
            axes.marks(frames[seen], sigma[seen, n], "_", pen)
        away = np.isfinite(distance[:, n]) & (distance[:, n] > 0.0)
        label = f"{curve.name}: |θ − final|"
        axes.marks(frames[:-1][away], distance[away, n], curve.marker, Pen(colour=curve.colour), label)
    axes.legend(columns=3)
    last = ", ".join(f"{c.name} {s:.3g}″" for c, s in zip(AXES, sigma[-1])) if len(sigma) else "none"
    return drawn(
        figure,
        "convergence",
        "Lines: predicted 1σ after each further strip. Marks: distance of θ from its final value.",
        f"Convergence over {len(frames)} strips; final 1-sigma: {last}.",
    )


def angle_histogram(saved: Saved) -> Drawing:
    """Histogram of cross-angle residuals divided by their predicted standard deviation."""
    ratio = column(saved.angles, "z") / column(saved.angles, "sigma")
    text = f"{len(ratio)} pairs of directions; standard deviation of z/σ {_rms(ratio):.3f}, expected 1."
    figure = Figure(2.6)
    x, edges = np.linspace(-4.5, 4.5, 181), np.linspace(-4.5, 4.5, 46)
    density = _density(ratio, edges)
    across = Axis("z / predicted σ", -4.7, 4.7)
    axes = figure.panel(across, Axis("fraction per unit", 0.0, 1.1 * max(0.4, *density)))
    axes.steps(edges, density, FILLED)
    axes.line(x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), Pen(width=1.4), "expected")
    axes.legend()
    return drawn(figure, "angle-histogram", text, f"Histogram of cross-angle residuals. {text}")


def angle_spread(saved: Saved) -> Drawing:
    """Measured against predicted standard deviation of cross angles, in groups of similar prediction."""
    z, sigma = column(saved.angles, "z"), column(saved.angles, "sigma")
    figure = Figure(2.6)
    groups = [g for g in np.array_split(np.argsort(sigma, kind="stable"), 12) if len(g) >= 5]
    predicted = np.array([_rms(sigma[g]) for g in groups]) / ARCSEC
    measured = np.array([_rms(z[g]) for g in groups]) / ARCSEC
    error = measured / np.sqrt(2.0 * np.array([len(g) for g in groups]))
    is_log = bool(len(groups)) and predicted.max() > 3.0 * predicted.min()
    ends = np.concatenate([measured - error, measured + error, predicted])
    axes = figure.panel(
        Axis.over("predicted σ of z, arc-seconds", predicted, is_log=is_log),
        Axis.over("measured rms of z, arc-seconds", ends, is_log=is_log),
    )
    axes.bars(predicted, measured - error, measured + error, Pen(colour=MUTED))
    axes.marks(predicted, measured, "o")
    axes.line(predicted, predicted, Pen(colour=MUTED, dash=DASHED, width=1.2), "measured = predicted")
    axes.legend(at_left=True)
    ratio = measured / predicted
    words = f"ratio from {ratio.min():.2f} to {ratio.max():.2f}" if len(ratio) else "no pairs"
    return drawn(
        figure,
        "angle-spread",
        f"{len(groups)} groups of equal prediction; {words}. Bars: 1σ as if all pairs were independent.",
        f"Measured against predicted spread of cross angles in {len(groups)} groups: {words}.",
    )


def star_residual_map(saved: Saved) -> Drawing:
    """Mean residual of the stars used, in cells of the star camera's detector, px, at their mean place."""
    camera = saved.context["star_camera"]
    kept = column(saved.stars, "kept").astype(bool)
    xy = list_values(saved.stars, "xy_px", 2)[kept]
    residual = -list_values(saved.stars, "residual_s", 3)[kept, :2] / camera["pixel_rad"]
    width, height = camera["width_px"], camera["height_px"]
    cell = max(width, height) / CELLS
    place, mean = _cell_means(xy, residual, cell, width)
    figure = Figure(0.6 + 0.8 * WIDTH_IN * height / width)
    across, down = (-0.5, width - 0.5), (height - 0.5, -0.5)
    axes = figure.panel(Axis("column, px", *across), Axis("row, px", *down), aspect=1.0)
    size = np.linalg.norm(mean, axis=1)
    scale = _nice(float(np.percentile(size, 90)) if len(size) else 0.0)
    _arrows(axes, place, mean, scale, cell)
    rms = _rms(residual.ravel())
    text = (
        f"Mean residual of {kept.sum()} stars in {len(place)} cells with {FEWEST_IN_CELL} or more; the arrow "
        f"in the corner is {scale:g} px. Single stars scatter by {rms:.3f} px rms per axis."
    )
    return drawn(figure, "star-map", text, f"Star residuals over the detector. {text}")


def residual_panels(saved: Saved, rows: Sequence[TargetCard]) -> list[Drawing]:
    """Residuals of targets on the ground, along and across the track: their scatter, the mean of each CCD,
    and against sample, line, time, height and, where it is stated, the temperature of the star camera.
    """
    ground, width = saved.ground, saved.context["remote_camera"]["samples"]
    start = np.concatenate([[0.0], np.cumsum(width)])
    ccd = column(ground, "ccd").astype(int)
    known = np.isfinite(column(ground, "residual_m"))
    against = {
        "sample": ("sample, CCDs side by side, px", start[np.maximum(ccd, 0)] + column(ground, "sample_px")),
        "line": ("line of the strip", column(ground, "line_px")),
        "time": _seconds_after(saved, column(ground, "t_s"), known),
        "height": ("ellipsoidal height of the target, m", column(ground, "height_m")),
    }
    warm = column(ground, "temperature_c")
    if np.isfinite(warm[known]).any():
        against["temperature"] = ("temperature of the star camera, °C", warm)
    shown = [row for row in rows if known[row.row]]
    both = {f"{which}, m": column(ground, f"residual_{which}_m") for which in ("along", "across")}
    of = "targets on the ground"
    panels = [_residual_panel(shown, name, x, both, of, "the map") for name, x in against.items()]
    return [ground_scatter(saved), ccd_means(saved), *panels]


def ground_scatter(saved: Saved) -> Drawing:
    """Residuals on the ground of the targets used, with the circle that holds 90 % and both histograms."""
    _, across, along = _used_on_ground(saved)
    ce90 = float(saved.context["accuracy"][0]["ce90_m"] or 0.0)
    reach = 1.15 * float(np.abs([*across, *along, ce90, 1e-3]).max())
    figure, edges, beside = Figure(WIDTH_IN), np.linspace(-reach, reach, 21), 0.8
    x, y = (Axis(f"{which} the track, m", -reach, reach) for which in ("across", "along"))
    axes = figure.panel(x, y, (0, beside, 0.2, 1))
    axes.marks(across, along, "o")
    axes.line(*_ellipse(ce90**2 * np.eye(2)), Pen(colour=AXES[1].colour, width=1.4))
    for values, is_turned, place in ((across, False, (0, beside, 0, 0.19)), (along, True, (0.81, 1, 0.2, 1))):
        counts, own = np.histogram(values, edges)[0], Axis("", -reach, reach)
        count = Axis("", 0.0, max(1.0, *counts))
        axes = figure.panel(*((count, own) if is_turned else (own, count)), place)
        axes.steps(edges, counts, FILLED, is_turned=is_turned)
    text = f"Residuals of {len(across)} sightings of targets; circle: CE90 {ce90:.2f} m."
    return drawn(figure, "ground-scatter", text, text)


def ccd_means(saved: Saved) -> Drawing:
    """Mean residual on the ground of each CCD's targets, its 1-sigma, and the spread of the residuals."""
    ccd, *residuals = _used_on_ground(saved)
    names, count = np.unique(ccd, return_counts=True)
    groups = [[values[ccd == one] for one in names] for values in residuals]
    mean, spread = (np.array([[of(group) for group in one] for one in groups]) for of in (np.mean, np.std))
    figure = Figure(WIDTH_IN)
    axes = figure.panel(
        Axis("CCD", min(names, default=0) - 0.5, max(names, default=0) + 0.5, is_whole=True),
        Axis.over("mean residual, m", [0.0, *(mean - spread).ravel(), *(mean + spread).ravel()]),
    )
    axes.level(0.0)
    for curve, name, off, middle, around in zip(AXES, ("across", "along"), (-0.08, 0.08), mean, spread):
        pen, error = Pen(colour=curve.colour), around / np.sqrt(count)
        axes.bars(names + off, middle - around, middle + around, pen)
        axes.bars(names + off, middle - error, middle + error, replace(pen, width=3.0))
        axes.marks(names + off, middle, curve.marker, replace(pen, fill=curve.colour), name)
    axes.legend()
    text = f"Mean residual of each of {len(names)} CCDs, thick its 1σ, thin the spread of the residuals."
    return drawn(figure, "ccd-means", text, text)


def _used_on_ground(saved: Saved) -> list[Floats]:
    """CCD, residual across and along the track, m, of each sighting of a target that was used."""
    used = np.array(saved.ground.column("state").to_pylist()) == State.USED.value
    return [column(saved.ground, name)[used] for name in ("ccd", "residual_across_m", "residual_along_m")]


def star_residual_panels(saved: Saved, rows: Sequence[SeenCard]) -> list[Drawing]:
    """Residuals of stars in strips of the sky, along x and y of the camera, against sample and line."""
    table = saved.targets
    start = np.concatenate([[0.0], np.cumsum(saved.context["remote_camera"]["samples"])])
    xy_px, residual = list_values(table, "xy_px", 2), list_values(table, "residual_c", 2) / ARCSEC
    across = start[column(table, "ccd").astype(int)] + xy_px[:, 0]
    against = {
        "star-sample": ("sample, CCDs side by side, px", across),
        "star-line": ("line of the strip", xy_px[:, 1]),
    }
    both = {"x, ″": residual[:, 0], "y, ″": residual[:, 1]}
    of = "stars in strips of the sky"
    return [_residual_panel(rows, name, x, both, of, "the sky") for name, x in against.items()]


def _residual_panel(
    rows: Sequence[SeenCard],
    name: str,
    against: tuple[str, Floats],
    both: dict[str, Floats],
    of: str,
    marks: str,
) -> Drawing:
    """Residuals of `both` kinds, by their labels, one above the other against a label and its values."""
    label, x = against
    figure, spots = Figure(3.4), []
    across = Axis.over(label, x[[row.row for row in rows]])
    for n, (which, y) in enumerate(both.items()):
        used = [row.row for row in rows if row.state == State.USED]
        reach = 1.3 * float(np.max(np.abs(y[used]), initial=0.0)) or 1.0
        below = replace(across, label=label if n else "")
        axes = figure.panel(below, Axis(which, -reach, reach), figure.cell(n, 2, 1, (0.0, 12.0)))
        axes.level(0.0)
        shown = np.clip(y, -0.97 * reach, 0.97 * reach)
        spots += [Spot.of(row, axes, x[row.row], shown[row.row]) for row in rows]
    beyond = sum(1 for row in rows if row.state == State.REJECTED)
    text = f"Residuals of {len(rows)} {of} against {name.removeprefix('star-')}; marks as on {marks}."
    text += f" {beyond} rejected: open marks, at the edge where they lie beyond it." if beyond else ""
    return drawn(figure, f"residual-{name}", text, text, spots)


def covariance_ellipses(saved: Saved) -> list[Drawing]:
    """Covariance ellipses of theta, one drawing per pair of axes, arcsec."""
    covariance = np.array(saved.installation["covariance_rad2"]) / ARCSEC**2
    drawings = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        names = f"{AXES[a].name}{AXES[b].name}"
        part = covariance[np.ix_([a, b], [a, b])]
        figure, reach = Figure(3.4), 1.15 * ELLIPSE_SIGMAS[1] * float(np.sqrt(np.diag(part).max()))
        across, down = (Axis(f"{AXES[n].name}, arc-seconds", -reach, reach) for n in (a, b))
        axes = figure.panel(across, down, aspect=1.0)
        for sigmas, dash in zip(ELLIPSE_SIGMAS, ("", DASHED)):
            axes.line(*_ellipse(sigmas**2 * part), Pen(width=1.4, dash=dash))
        axes.marks([0.0], [0.0], "+")
        correlation = part[0, 1] / np.sqrt(part[0, 0] * part[1, 1])
        text = (
            f"{names}: 1σ {np.sqrt(part[0, 0]):.4g}″ and {np.sqrt(part[1, 1]):.4g}″, "
            f"correlation {correlation:+.3f}."
        )
        caption = f"{text} Solid: 1σ (39 %), dashed: 95 %; both axes have one scale."
        words = f"Covariance ellipse of the axes {text}"
        drawings.append(drawn(figure, f"ellipse-{names.lower()}", caption, words))
    return drawings


def squared_residual_histogram(saved: Saved, table_name: str, what: str) -> Drawing:
    """Histogram of squared residuals over their variance (two degrees of freedom) of `saved.stars` or
    `saved.targets`.
    """
    table: pa.Table = getattr(saved, table_name)
    values = column(table, "normalised")
    kept = column(table, "kept").astype(bool)
    good = values[kept & np.isfinite(values)]
    figure = Figure(2.6)
    edges, x = np.linspace(0.0, 16.0, 41), np.linspace(0.0, 16.0, 161)
    across = Axis("squared residual over its variance", -0.4, 16.4)
    axes = figure.panel(across, Axis("fraction per unit", 1e-4, 1.0, is_log=True))
    axes.steps(edges, _density(np.minimum(good, 15.99), edges), FILLED)
    axes.line(x, 0.5 * np.exp(-0.5 * x), Pen(width=1.4), "expected (χ², 2 degrees)")
    axes.legend()
    mean = float(good.mean()) if len(good) else float("nan")
    text = f"{len(good)} {what} used, mean {mean:.3f} (2 expected); {int((~kept).sum())} rejected."
    words = f"Histogram of squared residuals over their variance. {text}"
    return drawn(figure, f"normalised-{table_name}", text, words)


def exposure_chi2(saved: Saved, rows: Sequence[ExposureCard]) -> Drawing:
    """Chi-square over degrees of freedom of every exposure's attitude fit against time."""
    table = saved.exposures
    usable = column(table, "usable").astype(bool)
    dof = column(table, "dof").astype(float)
    ratio = np.divide(column(table, "chi2"), dof, out=np.full(len(dof), np.nan), where=dof > 0)
    figure = Figure(2.6)
    label, t = _seconds_after(saved, column(table, "t_s"))
    shown = np.nan_to_num(ratio)
    spread = 2.0 * np.sqrt(2.0 / np.median(dof[usable])) if usable.any() else 0.0
    high = 1.05 * max(1.0 + spread, *shown)
    axes = figure.panel(Axis.over(label, t), Axis("χ² / degrees of freedom", 0.0, high))
    axes.band(max(1.0 - spread, 0.0), 1.0 + spread)
    axes.level(1.0, DASHED)
    spots = [
        Spot(axes=axes, x=x, y=y, link=row.link, style=f"{'used' if good else 'rejected'} s0", shape="circle")
        for row, x, y, good in zip(rows, t.tolist(), shown.tolist(), usable.tolist())
    ]
    mean = float(np.nanmean(ratio[usable])) if usable.any() else float("nan")
    text = f"Attitude fits of {usable.sum()} exposures, mean {mean:.3f} (1 expected); band: 2σ."
    return drawn(figure, "exposure-chi2", text, f"Chi-square of exposures against time. {text}", spots)


def allan_plot(saved: Saved) -> Drawing | None:
    """Allan deviation of the attitudes that star cameras deliver; None where they deliver none."""
    times = column(saved.allan, "averaged_s")
    if not len(times):
        return None
    deviation = list_values(saved.allan, "deviation_rad", 3) / ARCSEC
    figure, white = Figure(2.6), deviation[0] * np.sqrt(times[:1] / times)[:, None]
    axes = figure.panel(
        Axis.over("averaged over, s", times, is_log=True),
        Axis.over("Allan deviation, arc-seconds", [deviation, white], is_log=True),
    )
    for curve, measured, expected in zip(AXES, deviation.T, white.T):
        axes.marks(times, measured, curve.marker, Pen(colour=curve.colour), curve.name.lower())
        axes.line(times, expected, Pen(colour=curve.colour, dash=curve.dash, width=1.2))
    axes.legend()
    text = (
        f"{_whose_attitudes(saved.allan)} Lines: white noise, which averages out; what lies above them is "
        "correlated noise or motion of the satellite."
    )
    return drawn(figure, "allan", text, f"Allan deviation over {len(times)} times. {text}")


def attitudes_in_time(saved: Saved) -> Drawing | None:
    """Attitudes that star cameras deliver, less their median, against time; None where they deliver none."""
    label, t = _seconds_after(saved, column(saved.attitude_noise, "t_s"))
    if not len(t):
        return None
    turns = list_values(saved.attitude_noise, "turn_rad", 3) / ARCSEC
    turns -= np.median(turns, axis=0)
    figure = Figure(2.6)
    axes = figure.panel(Axis.over(label, t), Axis.over("arc-seconds, less their median", turns))
    for curve, values in zip(AXES, turns.T):
        pen = Pen(colour=curve.colour, dash=curve.dash, width=0.9)
        axes.line(t, values, pen, curve.name.lower())
    axes.legend()
    text = f"{_whose_attitudes(saved.attitude_noise)} A step is a jump of a head; slow waves are its drift."
    return drawn(figure, "attitudes", text, f"Attitudes at {len(t)} instants. {text}")


def _seconds_after(saved: Saved, t_s: Floats, of: Any = slice(None)) -> tuple[str, Floats]:
    """Label of an axis, and instants (N,) as seconds after the first full one `of` those."""
    first_s = float(np.floor(t_s[of].min())) if len(t_s[of]) else 0.0
    return f"seconds after {utc_text(saved.context['epoch_utc'], first_s)} UTC", t_s - first_s


def _whose_attitudes(table: pa.Table) -> str:
    heads = (table.schema.metadata or {}).get(b"heads", b"").decode()
    what = f"the difference of {heads}" if " and " in heads else f"{heads} against the nominal motion"
    return f"Attitudes about the axes of the star camera: {what}."


def _ellipse(covariance: Floats) -> tuple[Floats, Floats]:
    """Points of the ellipse x' covariance⁻¹ x = 1."""
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    x, y = vectors * np.sqrt(np.maximum(values, 0.0)) @ [np.cos(angle), np.sin(angle)]
    return x, y


def _density(values: Floats, edges: Any) -> Floats:
    """Fraction per unit of values (N,) between edges (M + 1,)."""
    return np.asarray(np.histogram(values, edges)[0] / max(len(values), 1) / np.diff(edges))


def _cell_means(xy: Floats, residual: Floats, cell: float, width: float) -> tuple[Floats, Floats]:
    columns = int(np.ceil(width / cell))
    index = (xy[:, 1] // cell).astype(int) * columns + (xy[:, 0] // cell).astype(int)
    place, mean = [], []
    for one in np.unique(index):
        rows = index == one
        if rows.sum() >= FEWEST_IN_CELL:
            place.append(xy[rows].mean(axis=0))
            mean.append(residual[rows].mean(axis=0))
    return np.array(place).reshape(-1, 2), np.array(mean).reshape(-1, 2)


def _arrows(axes: Panel, place: Floats, vector: Floats, scale: float, length: float) -> None:
    """Arrows at `place` (N, 2), as long as `length` for a vector of size `scale`: that one in the corner."""
    axes.marks(place[:, 0], place[:, 1], ".", Pen(colour=MUTED))
    axes.arrows(place, place + vector * (length / scale))
    ends = np.array([[0.6, 0.6], [1.6, 0.6], [1.85, 0.6]]) * [length, -length] + [axes.x.low, axes.y.low]
    axes.arrows(ends[:1], ends[1:2], Pen(width=1.8))
    axes.words(ends[2], f"{scale:g} px")


def _nice(value: float) -> float:
    """A round number of about this size."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda step: abs(step - value / power)))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
