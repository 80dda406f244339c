"""Plots of a report, each a function from the saved files to a `Drawing`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Ellipse
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from boresight.geometry.constants import ARCSEC
from boresight.geometry.ledger import State
from boresight.geometry.record import Floats
from boresight.pipeline.files.table_files import column, list_values
from boresight.pipeline.report.drawing import (
    AXES,
    FILL,
    INK,
    MUTED,
    WIDTH_IN,
    Drawing,
    Ruled,
    Spot,
    axes_of,
    drawn,
    new_figure,
    rule_axes,
)
from boresight.pipeline.report.observations import ExposureCard, SeenCard, TargetCard
from boresight.pipeline.report.saved import Saved, utc_text

__all__ = [
    "allan_plot",
    "angle_histogram",
    "angle_spread",
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
ELLIPSE_SIGMAS = (1.0, 2.4477)  # 39 and 95 per cent of a plane normal distribution


def convergence(saved: Saved) -> Drawing:
    """1-sigma of theta and distance of theta from its final value after each further strip, arcsec."""
    table = saved.convergence
    frames = column(table, "frames")
    theta, sigma = (list_values(table, name, 3) / ARCSEC for name in ("theta_rad", "sigma_rad"))
    end = theta[-1] if len(theta) else np.zeros(3)
    figure = new_figure(3.0, legend_in=0.35)
    axes = axes_of(figure, "star exposures so far", "arc-seconds")
    for n, curve in enumerate(AXES):
        seen = np.isfinite(sigma[:, n])
        axes.plot(
            frames[seen],
            sigma[seen, n],
            curve.dash,
            color=curve.colour,
            linewidth=1.6,
            marker="_" if seen.sum() == 1 else None,  # one point makes no line
            label=f"{curve.name}: 1σ",
        )
        distance = np.abs(theta[:-1, n] - end[n])
        shown = np.isfinite(distance) & (distance > 0.0)
        axes.plot(
            frames[:-1][shown],
            distance[shown],
            curve.marker,
            color=curve.colour,
            markersize=4,
            fillstyle="none",
            label=f"{curve.name}: |θ − final|",
        )
    _logarithmic(axes, "y")
    _legend(axes, ncols=3, loc="upper center", bbox_to_anchor=(0.5, 1.2))
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
    figure = new_figure(2.6)
    axes = axes_of(figure, "z / predicted σ", "fraction per unit")
    x = np.linspace(-4.5, 4.5, 181)
    _histogram(axes, ratio, x, np.exp(-0.5 * x**2) / np.sqrt(2.0 * np.pi), "expected")
    return drawn(figure, "angle-histogram", text, f"Histogram of cross-angle residuals. {text}")


def angle_spread(saved: Saved) -> Drawing:
    """Measured against predicted standard deviation of cross angles, in groups of similar prediction."""
    z, sigma = column(saved.angles, "z"), column(saved.angles, "sigma")
    figure = new_figure(2.6)
    axes = axes_of(figure, "predicted σ of z, arc-seconds", "measured rms of z, arc-seconds")
    groups = [g for g in np.array_split(np.argsort(sigma, kind="stable"), 12) if len(g) >= 5]
    predicted = np.array([_rms(sigma[g]) for g in groups]) / ARCSEC
    measured = np.array([_rms(z[g]) for g in groups]) / ARCSEC
    if len(groups):
        error = measured / np.sqrt(2.0 * np.array([len(g) for g in groups]))
        axes.errorbar(
            predicted, measured, error, fmt="o", color=INK, ecolor=MUTED, markersize=4, fillstyle="none"
        )
        span = np.array([predicted.min(), predicted.max()])
        axes.plot(span, span, "--", color=MUTED, linewidth=1.2, label="measured = predicted")
        _legend(axes, loc="upper left")
        if predicted.max() > 3.0 * predicted.min():
            _logarithmic(axes, "x", "y")
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
    figure = new_figure(0.6 + 0.9 * WIDTH_IN * height / width)
    axes = axes_of(figure, "column, px", "row, px")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    axes.set_aspect("equal")
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
    t_s = column(ground, "t_s")
    known = np.isfinite(column(ground, "residual_m"))
    first_s = float(np.floor(t_s[known].min())) if known.any() else 0.0
    against = {
        "sample": ("sample, CCDs side by side, px", start[np.maximum(ccd, 0)] + column(ground, "sample_px")),
        "line": ("line of the strip", column(ground, "line_px")),
        "time": (f"seconds after {utc_text(saved.context['epoch_utc'], first_s)} UTC", t_s - first_s),
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
    edges = np.linspace(-reach, reach, 21)
    figure = new_figure(WIDTH_IN)
    grid = figure.add_gridspec(2, 2, width_ratios=(4, 1), height_ratios=(1, 4), wspace=0.06, hspace=0.06)
    axes = figure.add_subplot(grid[1, 0], axes_class=Ruled)
    rule_axes(axes, "across the track, m", "along the track, m")
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.plot(across, along, "o", color=INK, markersize=3, fillstyle="none")
    axes.add_patch(Circle((0.0, 0.0), ce90, fill=False, edgecolor=AXES[1].colour, linewidth=1.4))
    sides: tuple[tuple[Any, Floats, Any], ...] = (
        (grid[0, 0], across, "vertical"),
        (grid[1, 1], along, "horizontal"),
    )
    for cell, values, turn in sides:
        beside = figure.add_subplot(cell)
        beside.set_axis_off()
        counts = np.histogram(values, edges)[0]
        beside.stairs(counts, edges, fill=True, orientation=turn, facecolor=FILL, edgecolor=MUTED)
        beside.set(**{"xlim" if turn == "vertical" else "ylim": (-reach, reach)})
    text = f"Residuals of {len(across)} sightings of targets; circle: CE90 {ce90:.2f} m."
    return drawn(figure, "ground-scatter", text, text)


def ccd_means(saved: Saved) -> Drawing:
    """Mean residual on the ground of each CCD's targets, its 1-sigma, and the spread of the residuals."""
    ccd, *residuals = _used_on_ground(saved)
    figure = new_figure(WIDTH_IN)
    axes = axes_of(figure, "CCD", "mean residual, m")
    axes.axhline(0.0, color=MUTED, linewidth=1.0)
    names, count = np.unique(ccd, return_counts=True)
    for curve, name, off, values in zip(AXES, ("across", "along"), (-0.08, 0.08), residuals):
        groups = [values[ccd == one] for one in names]
        mean, spread = (np.array([of(group) for group in groups]) for of in (np.mean, np.std))
        style: dict[str, Any] = {"color": curve.colour, "marker": curve.marker, "linestyle": "none"}
        axes.errorbar(names + off, mean, spread, elinewidth=0.8, label=name, **style)
        axes.errorbar(names + off, mean, spread / np.sqrt(count), elinewidth=3.0, **style)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _legend(axes, loc="upper right", ncols=2)
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
    figure = new_figure(3.4)
    panels = figure.subplots(2, 1, sharex=True, subplot_kw={"axes_class": Ruled})
    spots = []
    for axes, (which, y) in zip(panels, both.items()):
        rule_axes(axes, label if axes is panels[-1] else "", which)
        used = [row.row for row in rows if row.state == State.USED]
        axes.axhline(0.0, color=MUTED, linewidth=1.0)
        reach = 1.3 * float(np.max(np.abs(y[used]))) if used else 1.0
        axes.set_ylim(-reach, reach)
        axes.plot(x[[row.row for row in rows]], np.zeros(len(rows)), linestyle="none")  # limits of x
        inside = np.clip(y, -0.97 * reach, 0.97 * reach)
        spots += [Spot.of(row, axes, x[row.row], inside[row.row]) for row in rows]
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
        values, vectors = np.linalg.eigh(part)
        angle = float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1])))
        figure = new_figure(3.4)
        axes = axes_of(figure, f"{AXES[a].name}, arc-seconds", f"{AXES[b].name}, arc-seconds")
        for sigmas, dash in zip(ELLIPSE_SIGMAS, ("-", "--")):
            size = 2.0 * sigmas * np.sqrt(np.maximum(values, 0.0))
            shape = Ellipse((0.0, 0.0), float(size[1]), float(size[0]), angle=angle, linewidth=1.4)
            shape.set(edgecolor=INK, facecolor="none", linestyle=dash)
            axes.add_patch(shape)
        reach = 1.15 * ELLIPSE_SIGMAS[1] * float(np.sqrt(np.diag(part).max()))
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        axes.plot(0.0, 0.0, "+", color=INK, markersize=8)
        correlation = part[0, 1] / np.sqrt(part[0, 0] * part[1, 1])
        text = (
            f"{names}: 1σ {np.sqrt(part[0, 0]):.4g}″ and {np.sqrt(part[1, 1]):.4g}″, "
            f"correlation {correlation:+.3f}."
        )
        drawings.append(
            drawn(
                figure,
                f"ellipse-{names.lower()}",
                f"{text} Solid: 1σ (39 %), dashed: 95 %; both axes have one scale.",
                f"Covariance ellipse of the axes {text}",
            )
        )
    return drawings


def squared_residual_histogram(saved: Saved, table_name: str, what: str) -> Drawing:
    """Histogram of squared residuals over their variance (two degrees of freedom) of `saved.stars` or
    `saved.targets`.
    """
    table: pa.Table = getattr(saved, table_name)
    values = column(table, "normalised")
    kept = column(table, "kept").astype(bool)
    good = values[kept & np.isfinite(values)]
    figure = new_figure(2.6)
    axes = axes_of(figure, "squared residual over its variance", "fraction per unit")
    x = np.linspace(0.0, 16.0, 161)
    _histogram(axes, np.minimum(good, 15.99), x, 0.5 * np.exp(-0.5 * x), "expected (χ², 2 degrees)")
    _logarithmic(axes, "y", steps=(1.0,))
    axes.set_ylim(1e-4, 1.0)
    mean = float(good.mean()) if len(good) else float("nan")
    text = f"{len(good)} {what} used, mean {mean:.3f} (2 expected); {int((~kept).sum())} rejected."
    return drawn(
        figure,
        f"normalised-{table_name}",
        text,
        f"Histogram of squared residuals over their variance. {text}",
    )


def exposure_chi2(saved: Saved, rows: Sequence[ExposureCard]) -> Drawing:
    """Chi-square over degrees of freedom of every exposure's attitude fit against time."""
    table = saved.exposures
    usable = column(table, "usable").astype(bool)
    dof = column(table, "dof").astype(float)
    ratio = np.divide(column(table, "chi2"), dof, out=np.full(len(dof), np.nan), where=dof > 0)
    figure = new_figure(2.6)
    t = column(table, "t_s")
    first_s = float(np.floor(t[0])) if len(t) else 0.0
    after = utc_text(saved.context["epoch_utc"], first_s)
    axes, t = axes_of(figure, f"seconds after {after} UTC", "χ² / degrees of freedom"), t - first_s
    axes.plot(t, np.nan_to_num(ratio, nan=0.0), linestyle="none")  # limits
    spots = [
        Spot(
            axes=axes,
            x=float(t[n]),
            y=float(np.nan_to_num(ratio[n])),
            link=row.link,
            style="used s0" if usable[n] else "rejected s0",
            shape="circle",
        )
        for n, row in enumerate(rows[: len(t)])
    ]
    axes.axhline(1.0, color=MUTED, linestyle="--", linewidth=1.0)
    if usable.any():
        spread = 2.0 * np.sqrt(2.0 / np.median(dof[usable]))
        axes.axhspan(max(1.0 - spread, 0.0), 1.0 + spread, color=FILL, alpha=0.5, linewidth=0)
    axes.set_ylim(bottom=0.0)
    mean = float(np.nanmean(ratio[usable])) if usable.any() else float("nan")
    text = f"Attitude fits of {usable.sum()} exposures, mean {mean:.3f} (1 expected); band: 2σ."
    return drawn(figure, "exposure-chi2", text, f"Chi-square of exposures against time. {text}", spots)


def allan_plot(saved: Saved) -> Drawing | None:
    """Allan deviation of the attitudes that star cameras deliver; None where they deliver none."""
    times = column(saved.allan, "averaged_s")
    if not len(times):
        return None
    deviation = list_values(saved.allan, "deviation_rad", 3) / ARCSEC
    figure = new_figure(2.6)
    axes = axes_of(figure, "averaged over, s", "Allan deviation, arc-seconds")
    for n, curve in enumerate(AXES):
        style: dict[str, Any] = {"color": curve.colour, "markersize": 4, "fillstyle": "none"}
        axes.plot(times, deviation[:, n], curve.marker, label=curve.name.lower(), **style)
        axes.plot(times, deviation[0, n] * np.sqrt(times[0] / times), curve.dash, color=curve.colour, lw=1.2)
    _logarithmic(axes, "x", "y")
    _legend(axes, ncols=3, loc="upper right")
    heads = (saved.allan.schema.metadata or {}).get(b"heads", b"").decode()
    what = f"the difference of {heads}" if " and " in heads else f"{heads} against the nominal motion"
    text = (
        f"Attitudes about the axes of the star camera: {what}. Lines: white noise, which averages out; what "
    )
    text += "lies above them is correlated noise or motion of the satellite."
    return drawn(figure, "allan", text, f"Allan deviation over {len(times)} times. {text}")


def _logarithmic(axes: Axes, *which: str, steps: tuple[float, ...] = (1.0, 2.0, 5.0)) -> None:
    for name in which:
        axis = axes.xaxis if name == "x" else axes.yaxis
        axes.set(**{f"{name}scale": "log"})
        axis.set_major_locator(LogLocator(subs=steps))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


def _legend(axes: Axes, **where: Any) -> None:
    """A legend at a stated place: the best one is found by trying all over everything that is drawn."""
    axes.legend(fontsize=8, labelcolor=INK, frameon=False, **where)


def _histogram(axes: Axes, values: Floats, x: Any, expected: Floats, label: str) -> None:
    """Density of values in bins of four steps of x, below the curve that is expected at x."""
    counts, edges = np.histogram(values, x[::4])
    density = counts / max(len(values), 1) / np.diff(edges)
    axes.stairs(density, edges, fill=True, facecolor=FILL, edgecolor=MUTED, linewidth=0.8)
    axes.plot(x, expected, "-", color=INK, linewidth=1.4, label=label)
    _legend(axes, loc="upper right")


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


def _arrows(axes: Axes, place: Floats, vector: Floats, scale: float, length: float) -> None:
    if not len(place):
        return
    axes.plot(*place.T, ".", color=MUTED, markersize=2, linestyle="none")
    style: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": scale / length, "color": INK}
    axes.quiver(*place.T, *vector.T, width=0.004, **style)
    low, high = axes.get_xlim()[0], axes.get_ylim()[0]
    box = {"facecolor": "none", "edgecolor": "none", "pad": 1}
    x, y = low + 0.6 * length, high - 0.6 * length
    axes.quiver(x, y, scale, 0.0, width=0.007, **style)
    axes.text(x + 1.25 * length, y, f"{scale:g} px", fontsize=8, color=INK, va="center", bbox=box)


def _nice(value: float) -> float:
    """A round number of about this size."""
    if not value > 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * min((1.0, 2.0, 5.0, 10.0), key=lambda step: abs(step - value / power)))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float("nan")
