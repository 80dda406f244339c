"""The paper's printed values beside those of an experiment, like for like, as lines of text."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pandas as pd
from scipy.stats import chi2, kstest
from scipy.stats import f as f_distribution

from boresight.features.paper.geometry_search import covariance_shapes, predicted_sigma, star_camera_rotation
from boresight.features.paper.paper_tables import (
    FIGURE_7_CELLS,
    FIGURE_7_MEAN_ARCSEC,
    FIGURE_7_SIGMA_ARCSEC,
    FIGURES_5_6_Z_ARCSEC,
    TABLE_4,
    TABLE_4_RMS_ARCSEC,
    TABLE_5,
)
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.report.panels import AXES
from boresight.records.record import Floats
from boresight.simulator.campaign import CameraPair

__all__ = ["COMPARISONS", "errors_of_axes", "noise_law", "rms_of"]

# Height of the paper's satellite, m.
HEIGHT_M = 530e3
GAIN_M = float(np.mean([row[k] - row[k + 1] for row in TABLE_5.values() for k in (0, 2)]))  # over Wang
STAR_PIXEL_M = 6.4e-5 * HEIGHT_M  # one pixel of the star camera on the ground (Table 2)


def compare_convergence(table: pd.DataFrame) -> Iterator[str]:
    """Figs. 5 and 6: rms, bound and the paper's value after 150 and all frames."""
    yield "Figs. 5 and 6, arcsec. Paper: X and Y tend to 0 by 150 frames; Z as printed, one run"
    yield "sigma_s  sigma_c  frames  axis      rms    bound    paper"
    for (sigma_s, sigma_c), paper_z in FIGURES_5_6_Z_ARCSEC.items():
        cell = table[(table["sigma_s_px"] == sigma_s) & (table["sigma_c_px"] == sigma_c)]
        last = int(cell["frames"].max())
        for row in cell[cell["frames"].isin({min(150, last), last})].itertuples():
            paper = f"{paper_z:.1f}" if row.axis == "Z" else "to 0"
            head = f"{sigma_s:7.2f}  {sigma_c:7.1f}  {row.frames:6d}  {row.axis}"
            yield f"{head}     {row.rms_arcsec:8.4f} {row.bound_arcsec:8.4f} {paper:>8s}"


def compare_grid(table: pd.DataFrame) -> Iterator[str]:
    """Figs. 7 and 9: scatter over the grid; Fig. 7's mean against what its own scatter allows."""
    yield "Fig. 7: standard deviation over the grid, arcsec (ours: rms of all runs; its mean error is 0)"
    yield "frames  axis    ours    bound    paper  ours/paper"
    ours = table[table["method"] == "information"]
    for (frames, axis), part in ours.groupby(["frames", "axis"]):
        rms, bound = rms_of(part["rms_arcsec"]), rms_of(part["bound_arcsec"])
        paper = FIGURE_7_SIGMA_ARCSEC[AXES.index(axis)]
        yield f"{frames:6d}  {axis}    {rms:7.4f}  {bound:7.4f}  {paper:7.4f}  {rms / paper:8.2f}"
    last = ours[ours["frames"] == ours["frames"].max()]
    sizes = {"ours": [rms for _, rms, _ in errors_of_axes(last)]}
    for who, (x, y, z) in (sizes | {"paper": list(FIGURE_7_SIGMA_ARCSEC)}).items():
        yield f"Z over X and Y, {who}: {z / x:.1f}, {z / y:.1f} (text: 5 to 10)"
    cells = len(ours.groupby(["sigma_s_px", "sigma_c_px"]))
    yield f"Fig. 7: mean over the grid, arcsec; its standard error if {cells} cells are independent"
    for axis, mean, sigma in zip(AXES, FIGURE_7_MEAN_ARCSEC, FIGURE_7_SIGMA_ARCSEC):
        error = sigma / np.sqrt(cells)
        largest = np.abs(ours[ours["axis"] == axis]["mean_arcsec"]).max()
        yield (
            f"  {axis}  paper {mean:+.4f} +- {error:.4f}: {abs(mean) / error:.1f} standard errors from 0;"
            f" ours: no cell's mean exceeds {largest:.4f}"
        )
    yield "Fig. 9 (Wang, 7 strips): rms over the grid, arcsec; the paper prints only Table 4's five cells"
    yield "axis    Wang's method  ours, same strips    bound  paper's Wang"
    methods = (errors_of_axes(table[table["method"] == name]) for name in ("wang", "strips"))
    for (axis, wang, bound), (_, strips, _), paper in zip(*methods, TABLE_4_RMS_ARCSEC["wang"]):
        yield f"{axis}       {wang:11.4f}  {strips:17.4f}  {bound:7.4f}  {paper:12.4f}"


def compare_table4(table: pd.DataFrame) -> Iterator[str]:
    """Table 4: rms over its five rows, and how much better than Wang's method."""
    yield "Table 4: rms over the five rows, arcsec"
    yield "axis     ours    bound    paper | 7 strips: Wang    ours   bound  paper's Wang"
    gains = []
    methods = (errors_of_axes(table[table["method"] == name]) for name in ("information", "wang", "strips"))
    papers = (TABLE_4_RMS_ARCSEC[who] for who in ("paper", "wang"))
    for (axis, ours, bound), (_, wang, _), (_, same, same_bound), paper, paper_wang in zip(*methods, *papers):
        yield (
            f"{axis}     {ours:7.4f}  {bound:7.4f}  {paper:7.4f} |"
            f" {wang:14.4f}  {same:6.4f}  {same_bound:6.4f}  {paper_wang:12.4f}"
        )
        gains.append((axis, wang / ours, wang / same, paper_wang / paper))
    yield "Rows: sigma_s, sigma_c, px; X, Y, Z of ours, bound, paper (one run)"
    own_method = table[table["method"] == "information"]
    for sigma_s, sigma_c in TABLE_4:
        part = own_method[(own_method["sigma_s_px"] == sigma_s) & (own_method["sigma_c_px"] == sigma_c)]
        columns = [part[name].to_numpy() for name in ("rms_arcsec", "bound_arcsec", "paper_arcsec")]
        texts = [" ".join(f"{value:.4f}" for value in column) for column in columns]
        yield f"  {sigma_s:.2f}, {sigma_c:.1f}: {texts[0]}; {texts[1]}; {texts[2]}"
    yield "Rows: sigma_s, sigma_c, px; the paper's Wang over the paper's own, X, Y, Z"
    for (sigma_s, sigma_c), (wang_draw, draw) in TABLE_4.items():
        gain = "  ".join(f"{abs(value):.1f}" for value in np.divide(wang_draw, draw))
        yield f"  {sigma_s:.2f}, {sigma_c:.1f}: {gain}"
    yield "Wang's error over ours: 400 frames against 7 strips (as in the paper); same 7 strips; paper"
    yield from (f"  {axis}  {many:6.1f}  {same:6.1f}  {paper:6.1f}" for axis, many, same, paper in gains)
    own = np.array([own for _, own in TABLE_4.values()])
    left = np.sum((own - FIGURE_7_MEAN_ARCSEC) ** 2, axis=0) / np.square(FIGURE_7_SIGMA_ARCSEC)
    yield "Table 4 against Fig. 7, both the paper's: squared deviations of its rows from Fig. 7's mean over"
    yield "Fig. 7's variance; a grid of n cells that contains these rows cannot exceed n"
    for axis, value in zip(AXES, left):
        p = chi2(len(own)).sf(value)
        yield f"  {axis}  {value:6.1f} (5 expected, p {p:.1e}; our grid has {len(FIGURE_7_CELLS)} cells)"


def compare_table4_pixels(table: pd.DataFrame) -> Iterator[str]:
    """Table 4 from rendered images: rms of the missions beside their stated 1-sigma, per row and pooled."""
    runs, n = int(table["runs"].iloc[0]), int(table["runs"].sum()) // 3
    yield f"Table 4 from pixels, {runs} missions a row, arcsec"
    yield "paper: single draws of its own cameras, of 5 and 24 times as many pixels (over their bound)"
    yield "row:       stated:     | rms:                   | bound:"
    yield "s, c, px   s, c, px    | X, Y, Z                | X, Y, Z                | NEES"
    for (row_s, row_c), part in table.groupby(["row_s_px", "row_c_px"]):
        head = f"{row_s:.2f}, {row_c:.1f}  {part['sigma_s_px'].iloc[0]:.3f}, {part['sigma_c_px'].iloc[0]:.2f}"
        rms, bound = (", ".join(f"{v:6.2f}" for v in part[c]) for c in ("rms_arcsec", "bound_arcsec"))
        yield f"{head} | {rms} | {bound} | {part['nees'].iloc[0]:4.2f}"
    yield "row, s, c, px: the paper's X, Y, Z (over its bound)"
    for (row_s, row_c), part in table.groupby(["row_s_px", "row_c_px"]):
        values = zip(part["paper_arcsec"], part["paper_arcsec"] / part["paper_bound_arcsec"])
        paper = ", ".join(f"{value:.4f} ({ratio:.1f})" for value, ratio in values)
        yield f"{row_s:.2f}, {row_c:.1f}  {paper}"
    yield f"Pooled over the {n} missions; expected 1 and 3,"
    yield f"of which chance alone leaves {np.sqrt(0.5 / n):.2f} and {np.sqrt(6 / n):.2f} (1 sigma)"
    for axis in AXES:
        part = table[table["axis"] == axis]
        yield f"  {axis}  rms / bound {rms_of(part['rms_arcsec'] / part['bound_arcsec']):.3f}"
    yield f"  NEES {table['nees'].mean():.2f}"
    yield f"CPU {table['cpu_s'].sum() / 3:.0f} s, one core"


def compare_grid_pixels(table: pd.DataFrame) -> Iterator[str]:
    """The grid from rendered images against the same vectors with new noise, pooled and cell by cell."""
    pixels, vectors = (table[table["method"] == name] for name in ("pixels", "vectors"))
    cells, runs, redrawn = len(pixels) // 3, int(pixels["runs"].iloc[0]), int(vectors["runs"].iloc[0])
    yield f"Grid of Figs. 7 and 9 from pixels: {cells} cells of {runs} missions; vectors: the same stars and"
    yield f"targets with new noise of the stated covariances, {redrawn} runs a cell. Expected ratio 1, NEES 3"
    yield "p: F-test, two-sided, that pixels and vectors have one mean square in units of the bound"
    yield "      pixels:                    vectors:                          paper: scatter"
    yield "axis     rms    bound   ratio       rms    bound   ratio       p   / bound"
    for axis, part in pixels.groupby("axis"):
        other = vectors[vectors["axis"] == axis]
        squares = part["mean_square"].mean(), other["mean_square"].mean()
        p = _f_test(squares[0], cells * runs, squares[1], cells * redrawn)
        columns = [
            f"{rms_of(t['rms_arcsec']):7.3f} {rms_of(t['bound_arcsec']):8.3f} {np.sqrt(square):7.3f}"
            for t, square in zip((part, other), squares)
        ]
        paper = "{:.4f} / {:.4f}".format(*part[["paper_arcsec", "paper_bound_arcsec"]].iloc[0])
        yield f"{axis}    {columns[0]}   {columns[1]}  {p:6.3f}   {paper}"
    nees = [t[t["axis"] == "X"]["nees"] for t in (pixels, vectors)]
    p = _f_test(nees[0].mean(), 3 * cells * runs, nees[1].mean(), 3 * cells * redrawn)
    yield f"NEES  pixels {nees[0].mean():.3f}, vectors {nees[1].mean():.3f}, p {p:.3f}"
    whole = kstest(nees[0] * runs, chi2(3 * runs).cdf).pvalue
    yield f"NEES of the cells against chi-square of {3 * runs} degrees: Kolmogorov-Smirnov p {whole:.3f}"
    low, high = chi2(3 * runs).ppf([0.005, 0.995]) / runs
    outside = int((~nees[0].between(low, high)).sum())
    yield f"cells outside the 99 % band of NEES, {low:.2f} to {high:.2f}: {outside} of {cells}"
    yield "rms / bound of the pixels over the cells of one sigma_s, then of one sigma_c"
    for column in ("row_s_px", "row_c_px"):
        for value, part in pixels.groupby(column):
            by_axis = part.groupby("axis")["mean_square"].mean()
            texts = "  ".join(f"{axis} {np.sqrt(square):5.3f}" for axis, square in by_axis.items())
            yield f"  {column[4:5]} {value:4.2f} px  {texts}  ({len(part) // 3 * runs} missions)"
    yield f"CPU {pixels['cpu_s'].sum() / 3:.0f} s, one core"


def _f_test(square: float, n: int, other: float, m: int) -> float:
    """Two-sided p-value that mean squares of `n` and `m` degrees of freedom have one expectation."""
    above = f_distribution(n, m).sf(square / other)
    return float(2.0 * min(above, 1.0 - above))


def compare_table5(table: pd.DataFrame) -> Iterator[str]:
    """Table 5 and Fig. 10: errors at check points, and the law in sigma_s that the paper's columns follow."""
    yield "Table 5: rms at check points, m; floor: all errors of Table 1, attitude and matrix perfect"
    yield "sigma_s  direction   ours  Wang's method  floor | paper  paper's Wang"
    ours, wang = (table[table["method"] == name] for name in ("information", "wang"))
    for row, theirs in zip(ours.itertuples(), wang.itertuples()):
        yield (
            f"{row.sigma_s_px:7.3f}  {row.direction:9s}  {row.rms_m:5.2f}  {theirs.rms_m:13.2f}"
            f"  {row.floor_m:5.2f} | {row.paper_m:5.2f}  {theirs.paper_m:12.2f}"
        )
    n, gain = ours["check_points"].iloc[0], wang["rms_m"].mean() - ours["rms_m"].mean()
    yield f"{n} check points a run; gain over Wang's method, mean: ours {gain:.2f} m, paper {GAIN_M:.2f} m"
    yield "The paper's columns as rms² = a² + (b sigma_s)²; one star camera's pixel is"
    yield f"{STAR_PIXEL_M:.1f} m on the ground, divided by the square root of the number of stars averaged"
    sigma_s, slopes = np.array(list(TABLE_5)), []
    for n, name in enumerate(("along, Wang", "along, paper", "across, Wang", "across, paper")):
        a, b = noise_law(sigma_s, np.array([row[n] for row in TABLE_5.values()]))
        yield f"  {name:13s}  a {a:5.2f} m   b {b:5.1f} m/px: as of {(STAR_PIXEL_M / b) ** 2:5.2f} stars"
        slopes.append(b)
    yield "Stars of a single exposure that gives both slopes of the paper, by the star camera's axis"
    for from_zenith, azimuth, stars in exposures_of_slopes(slopes[1], slopes[3]):
        yield f"  {from_zenith:3.0f} deg from the zenith, azimuth {azimuth:3.0f} deg: {stars:5.1f} stars"


def exposures_of_slopes(along_m: float, across_m: float) -> Iterator[tuple[float, float, float]]:
    """(from zenith, azimuth, stars), degrees, of single exposures with these ground errors per pixel."""
    nadir = CameraPair(star_camera_rotation(0.0, 0.0, 0.0))
    shapes, none, one = covariance_shapes(nadir), np.full(1, np.inf), np.ones(1)
    for from_zenith in range(0, 91, 15):
        found = []
        for azimuth in range(91):
            R_cs = star_camera_rotation(from_zenith, azimuth, 0.0)
            x, y, _ = predicted_sigma(R_cs, shapes, [(1.0, 0.0)], one, none)[0] * ARCSEC * HEIGHT_M
            found.append((abs(np.log(y / x * across_m / along_m)), azimuth, (x**2 + y**2)))
        misfit, azimuth, size = min(found)
        if misfit < 0.02:
            yield from_zenith, azimuth, float(size) / (along_m**2 + across_m**2)


def compare_readings(table: pd.DataFrame) -> Iterator[str]:
    """Table 5 with Wang's matrices of single images: rms over all strips, by what the paper leaves open."""
    yield "Table 5 with one matrix per image (Wang) against the estimate from all images (ours): rms, m"
    yield "sigma_s  ours: along, across | Wang: order 3      5            7"
    for (axis, gps, attitude), case in table.groupby(["axis", "gps", "attitude"], sort=False):
        yield f"axis {axis}, GPS error {gps}, attitude {attitude}"
        for sigma_s, part in case.groupby("sigma_s_px", sort=False):
            rms = part.set_index(["method", "order", "direction"])["rms_m"].to_dict()
            cells = [("ours", 0), ("wang", 3), ("wang", 5), ("wang", 7)]
            texts = [f"{rms[*cell, 'along']:5.2f}, {rms[*cell, 'across']:5.2f}" for cell in cells]
            yield f"{sigma_s:7.3f}  {texts[0]:19s} | {'  '.join(texts[1:])}"
    like = table[(table["gps"] == "constant") & (table["attitude"] == "smoothed")]
    yield "Wang's method, order 3, over ours; GPS constant, smoothed attitudes"
    for axis in like["axis"].unique():
        part = like[like["axis"] == axis]
        own, third = (
            part[(part["method"] == name) & (part["order"] == order)]["rms_m"].to_numpy()
            for name, order in (("ours", 0), ("wang", 3))
        )
        more, gain = 100.0 * (third / own - 1.0), third - own
        percent = f"{more.min():.0f} to {more.max():.0f} % (paper: more than 20 %)"
        yield f"  {axis}: {percent}, {gain.min():.1f} to {gain.max():.1f} m (paper: {GAIN_M:.1f} m)"
    for sigma_s, row in TABLE_5.items():
        if sigma_s in (0.05, 0.075, 0.1):
            yield f"paper, {sigma_s:.3f}: ours {row[1]:.2f}, {row[3]:.2f}; Wang {row[0]:.2f}, {row[2]:.2f}"


def compare_inputs(table: pd.DataFrame) -> Iterator[str]:
    """Lines that set ours against the paper's Tables 1 to 3 and numbers of its text; for a curve the largest
    difference.
    """
    yield "Tables 1 to 3 and the text: printed value, ours, and what arithmetic gives"
    yield "source  item                              unit       paper      ours  arithmetic"
    for row in table[table["at"].isna()].to_dict("records"):
        expected = "" if np.isnan(row["expected"]) else f"{row['expected']:11.3f}"
        head = f"{row['source']:7s} {row['item']:33s} {row['unit']:7s}"
        yield f"{head} {row['paper']:8.4g} {row['ours']:9.4g} {expected}".rstrip()
    for (source, unit), curve in table[table["at"].notna()].groupby(["source", "unit"], sort=False):
        printed = curve[curve["paper"].notna()]
        off = np.abs(printed["ours"] - printed["paper"]).max()
        yield (
            f"{source}, distortion: at {len(printed)} points up to {printed['paper'].max():.6g} {unit},"
            f" ours differs by at most {off:.1e} {unit}"
        )


def compare_figure4(table: pd.DataFrame) -> Iterator[str]:
    """Fig. 4: size of our waves and the star camera's noise."""
    yield "Fig. 4: attitude over 24 s, arcsec; the paper prints no value, it shows 24 s about the mean"
    for axis, part in table.groupby("axis", sort=False):
        wave, noise = part["attitude_arcsec"], part["sigma_arcsec"].iloc[0]
        peak = np.abs(wave).max()
        yield f"  {axis:5s}  rms {rms_of(wave):5.2f}  peak {peak:5.2f}  one exposure {noise:.2f}"


def compare_figure8(table: pd.DataFrame) -> Iterator[str]:
    """Fig. 8: rms of the residuals by order."""
    yield "Fig. 8: rms residual of polynomials, arcsec; paper: no significant improvement from order 5 to 7"
    yield "span s  axis   order 3  order 5  order 7   order 7 / order 5"
    for (span, axis), part in table.groupby(["span_s", "axis"], sort=False):
        rms = [rms_of(part[part["order"] == order]["residual_arcsec"]) for order in (3, 5, 7)]
        yield f"{span:6g}  {axis:5s}  {rms[0]:7.4f}  {rms[1]:7.4f}  {rms[2]:7.4f}   {rms[2] / rms[1]:8.3f}"


def compare_geometry(table: pd.DataFrame) -> Iterator[str]:
    """Lines of text on the geometry that the paper may have had: the best fit to each goal, and the
    directions within 20 % of the paper.
    """
    yield "Geometry that fits best, closed-form covariance; misfit: largest ratio to the paper, either way"
    goals = {
        str(goal): part.sort_values("misfit").iloc[0] for goal, part in table.groupby("goal", sort=False)
    }
    yield "goal         zenith  azimuth  roll    stars  targets  spread  misfit"
    for goal, best in goals.items():
        yield (
            f"{goal:11s}  {best['from_zenith_deg']:6.0f}  {best['azimuth_deg']:7.0f}  {best['roll_deg']:4.0f}"
            f"  {best['stars']:7.0f}  {best['targets']:7.0f}  {best['spread']:6.2f}  {best['misfit']:6.2f}"
        )
    yield "goal         Fig. 7: X, Y, Z         Table 4: X, Y, Z"
    for goal, best in goals.items():
        fits = [
            "  ".join(f"{best[f'fit_{name}_{axis}']:.4f}" for axis in "xyz") for name in ("figure7", "table4")
        ]
        yield f"{goal:11s}  {fits[0]}  {fits[1]}"
    for name, values in (("Fig. 7", FIGURE_7_SIGMA_ARCSEC), ("Table 4", TABLE_4_RMS_ARCSEC["paper"])):
        z = f"Z is {values[2] / values[0]:.1f} times X and {values[2] / values[1]:.1f} times Y"
        yield f"paper, {name:7s}: {'  '.join(f'{v:.4f}' for v in values)}; {z} (5 to 10)"
    for what, part in table.groupby("goal", sort=False):
        good = part[part["misfit"] <= 1.2]
        if not len(good):
            yield f"{what}: no direction within 20 %"
            continue
        low, high = good["from_zenith_deg"].min(), good["from_zenith_deg"].max()
        yield (
            f"{what}: {len(good)} of {len(part)} directions within 20 %, {low:.0f} to {high:.0f} deg from"
            f" the zenith, azimuth up to {good['azimuth_deg'].max():.0f} deg,"
            f" {good['targets'].min():.0f} targets or more"
        )


# What compares the table of an experiment with the paper, by the experiment's name.
COMPARISONS: dict[str, Callable[[pd.DataFrame], Iterator[str]]] = {
    "convergence": compare_convergence,
    "inputs": compare_inputs,
    "figure4": compare_figure4,
    "figure8": compare_figure8,
    "geometry": compare_geometry,
    "grid": compare_grid,
    "table4": compare_table4,
    "table5": compare_table5,
    "readings": compare_readings,
    "grid-pixels": compare_grid_pixels,
    "table4-pixels": compare_table4_pixels,
}


def noise_law(sigma_px: Floats, rms: Floats) -> tuple[float, float]:
    """(a, b) of rms² = a² + (b sigma)², by least squares, of `rms` (N,) at `sigma_px` (N,)."""
    slope, constant = np.polyfit(sigma_px**2, rms**2, 1)
    return float(np.sqrt(max(constant, 0.0))), float(np.sqrt(max(slope, 0.0)))


def errors_of_axes(table: pd.DataFrame) -> Iterator[tuple[str, float, float]]:
    """Each axis with the rms of its errors and of their bounds over the rows of a table, arcsec."""
    for axis in AXES:
        part = table[table["axis"] == axis]
        yield axis, rms_of(part["rms_arcsec"]), rms_of(part["bound_arcsec"])


def rms_of(values: pd.Series) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))
