"""Places of marks and lengths of scales on figures and map, against numbers by hand."""

from __future__ import annotations

import re
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS

from boresight.pipeline.report import figures
from boresight.pipeline.report.drawing import Axis
from boresight.pipeline.report.first_screen import _helps
from boresight.pipeline.report.map_view import CAPTION, GAP, LONGEST, WIDTH, _check, _layout, map_view
from boresight.pipeline.report.observations import TargetCard, strip_star_rows
from boresight.pipeline.report.saved import Saved
from boresight.pipeline.report.sheet import angles
from boresight.pipeline.report.star_image import star_detection
from boresight.pipeline.report.strips_on_sky import _tangents


def card(row: int, **more: Any) -> TargetCard:
    of_all = {"target_id": f"t{row}", "ccd": 0, "cause": "", "reason": "", "shape": "circle", "colour": "s0"}
    rest = {"numbers": {}, "pictures": None, "printed": False}
    return TargetCard(link=f"c{row}", row=row, strip_id="s01", state="used", **of_all | rest | more)


NUMBER = re.compile(
    r'<text x="([-\d.]+)" y="([-\d.]+)" font-size="8.5" text-anchor="(middle|end)">([−\d.]+)</text>'
)


def scales(svg: str) -> tuple[Any, list[Any]]:
    """From places in a figure to x, and in each of its panels to y, by the numbers beside the axes."""
    numbers = [(float(x), float(y), end, float(t.replace("−", "-"))) for x, y, end, t in NUMBER.findall(svg)]
    middle = np.array([(x, t) for x, _, end, t in numbers if end == "middle"])
    across = np.polynomial.Polynomial.fit(*middle.T, 1)
    down = np.array([(y - 3.0, t) for _, y, end, t in numbers if end == "end"])  # the baseline is 3 pt below
    panels = np.split(down, np.flatnonzero(np.diff(down[:, 1]) < 0.0) + 1)
    return across, [np.polynomial.Polynomial.fit(*panel.T, 1) for panel in panels]


def test_residuals_of_stars_stand_at_their_samples_and_lines() -> None:
    arcsec = np.array([[0.5, -1.0], [-0.25, 0.75]])
    residual_c = [[float(x), float(y)] for x, y in np.radians(arcsec / 3600.0)]
    table = {"ccd": [0, 2], "xy_px": [[10.0, 700.0], [30.5, 200.0]], "residual_c": residual_c}
    fixed = pa.list_(pa.float64(), 2)
    saved = SimpleNamespace(
        context={"remote_camera": {"samples": [512, 500, 512]}},
        targets=pa.table(table, pa.schema([("ccd", pa.int64()), ("xy_px", fixed), ("residual_c", fixed)])),
    )
    drawings = figures.star_residual_panels(saved, [card(0), card(1)])  # type: ignore[arg-type]
    places = {"sample": [10.0, 512.0 + 500.0 + 30.5], "line": [700.0, 200.0]}  # CCDs side by side
    for (name, x), drawing in zip(places.items(), drawings, strict=True):
        assert f'id="residual-star-{name}-words"' in drawing.svg
        to_x, to_y = scales(drawing.svg)
        at = np.array(re.findall(r'class="dot [^>]*translate\(([\d.]+) ([\d.]+)\)', drawing.svg), dtype=float)
        assert len(to_y) == 2 and len(at) == 4
        for n, panel in enumerate(to_y):  # that of x, then that of y; numbers stand on tenths of a point
            np.testing.assert_allclose(to_x(at[2 * n :][:2, 0]), x, atol=1e-3 * np.ptp(x))
            np.testing.assert_allclose(panel(at[2 * n :][:2, 1]), arcsec[:, n], atol=4e-3)


def test_bars_of_a_ccd_are_its_mean_sigma_and_spread_those_across_left_of_those_along() -> None:
    metres = {"residual_across_m": [1, 2, 6, -1, -3, 50], "residual_along_m": [0.5, 1.5, 1, 4, -2, 90]}
    ground = pa.table({"state": ["used"] * 5 + ["rejected"], "ccd": [0, 0, 0, 2, 2, 2]} | metres)
    svg = figures.ccd_means(SimpleNamespace(ground=ground)).svg  # type: ignore[arg-type]
    to_x, (to_y,) = scales(svg)
    for values, off, name in zip(metres.values(), (-0.08, 0.08), "xy"):
        mean, spread = np.array([[np.mean(one), np.std(one)] for one in (values[:3], values[3:5])]).T
        parts = re.findall(rf'd="([^"]+)" style="[^"]*stroke:var\(--{name}\);[^"]*" clip', svg)
        sizes = spread, spread / np.sqrt([3.0, 2.0]), 0.0 * mean  # thin, thick, mark
        for d, half, ends in zip(parts, sizes, ([-1, 1], [-1, 1], [0]), strict=True):
            x, y = np.array(re.findall(r"[ML]([\d.]+) ([\d.]+)", d), dtype=float).reshape(2, -1, 2).T
            np.testing.assert_allclose(to_x(x) - [0.0, 2.0], off, atol=0.01)  # numbers stand on tenths of a
            np.testing.assert_allclose(to_y(y), mean + np.outer(ends, half), atol=0.01)  # point, 3 mm


@pytest.mark.parametrize(
    ("low", "high", "is_log", "texts"),
    [
        (-1.3, 2.2, False, ["−1", "0", "1", "2"]),
        (0.0, 0.012, False, ["0.0000", "0.0025", "0.0050", "0.0075", "0.0100"]),
        (-3e-5, 3e-5, False, ["−2", "0", "2"]),
        (1e6, 1.1e6, False, ["1.00", "1.02", "1.04", "1.06", "1.08", "1.10"]),
        (0.9, 120.0, True, ["1", "2", "5", "10", "20", "50", "100"]),
        (2e-4, 3.0, True, ["0.001", "0.01", "0.1", "1"]),
        (0.5, 3.5, False, ["1", "2", "3"]),
    ],
)
def test_numbers_of_an_axis_are_round_and_are_those_of_their_places(low, high, is_log, texts):
    at, found, label = Axis("x", low, high, is_log=is_log).numbers(5)
    factor = float(label[3:-1]) if "(" in label else 1.0
    written = [float(text.replace("−", "-")) * factor for text in found]
    np.testing.assert_allclose(written, at, rtol=1e-9, atol=1e-9 * (high - low))
    assert low <= min(at) and max(at) <= high
    assert found == texts


def test_an_axis_holds_its_values_and_one_with_equal_ratios_those_above_zero() -> None:
    values = [-2.0, 0.0, 1e-3, 5.0, np.nan, np.inf]
    even, log = (Axis.over("x", values, is_log=is_log) for is_log in (False, True))
    assert -2.5 < even.low < -2.0 and 5.0 < even.high < 5.5
    assert 0.5e-3 < log.low < 1e-3 and 5.0 < log.high < 10.0
    np.testing.assert_allclose(log.shares([log.low, np.sqrt(log.low * log.high), log.high]), [0.0, 0.5, 1.0])


def view_of(boxes: dict[str, list[float]], ground: dict[str, Any]) -> Any:
    """The map of scenes of one strip each, by the strip's id."""
    place = {"lat_deg": -33.0, "lon_deg": -70.0}
    scenes = [place | {"box_m": box, "strips": [{"id": id, "outlines_m": []}]} for id, box in boxes.items()]
    saved = SimpleNamespace(
        context={"scenes": scenes}, ground=pa.table(ground), map=pa.table({}), validation={}
    )
    view = map_view(saved, [card(n) for n in range(len(ground["scene"]))])  # type: ignore[arg-type]
    assert view is not None
    return view


def test_the_scales_of_the_map_are_those_of_its_places_and_arrows() -> None:
    east, north = [100.0, 8100.0, 100.0], [200.0, 200.0, 6200.0]
    toward = [[3.0, 4.0], [0.0, 2.5], [-1.0, 0.0]]  # m east and north
    ground = {"scene": [0, 0, 0], "east_m": east, "north_m": north, "residual_m": [5.0, 2.5, 1.0]}
    ground |= dict(zip(("residual_east_m", "residual_north_m"), map(list, zip(*toward))))
    view = view_of({"s01": [-1000.0, -500.0, 11_000.0, 8_500.0]}, ground)
    spots = {spot.row.row: spot for spot in view.spots}
    # Places are rounded to 0.01 units, of some 10 m each.
    metres = view.metres
    assert (spots[1].x - spots[0].x) * metres == pytest.approx(8000.0, abs=0.02 * metres)
    assert (spots[0].y - spots[2].y) * metres == pytest.approx(6000.0, abs=0.02 * metres)  # y downwards
    for row, (e, n) in enumerate(toward):
        dx, dy = map(float, re.match(r"M\S+ \S+l(\S+) (\S+)l", spots[row].arrow).groups())  # type: ignore[union-attr]
        length = view.residual_metres * np.array([dx, -dy])
        if not spots[row].is_cut:
            np.testing.assert_allclose(length, [e, n], atol=0.01 * view.residual_metres)
    assert [spots[row].is_cut for row in (1, 2)] == [False, False]
    assert view.scenes[0].caption == "s01   33.00° S, 70.00° W"


def test_numbers_of_a_star_are_those_of_its_row_in_its_units() -> None:
    row = {"range_m": float("inf"), "kept": True, "t_s": 12.5, "probability_wrong": 2e-7}
    row |= {"normalised": 6.25, "residual_c": [3e-6, -7e-6]}  # the former is squared
    row |= {"strip_id": "sky01", "target_id": "HIP 17499", "ccd": 2, "xy_px": [211.5, 907.25]}
    row |= {"cov_px": [0.0121, 0.002, 0.002, 0.0484]}  # px², row after row
    table = pa.Table.from_pylist([row])
    no_matches = pa.table({name: [] for name in ("strip_id", "target_id", "ccd")})
    context = {"epoch_utc": "2025-03-20T03:40:00Z"}
    saved = SimpleNamespace(targets=table, matches=no_matches, context=context)
    saved.cell = partial(Saved.cell, saved)
    (star,) = strip_star_rows(saved, 3)  # type: ignore[arg-type]
    arcsec = 648_000.0 / np.pi
    expected = {"sigmas": 2.5, "residual_x": 3e-6 * arcsec, "residual_y": -7e-6 * arcsec}
    expected |= {"sample_px": 211.5, "line_px": 907.25, "sigma_sample_px": 0.11, "sigma_line_px": 0.22}
    shown = {name: star.numbers[name] for name in expected}
    assert {name: one.exact * one.scale for name, one in shown.items()} == pytest.approx(expected)
    assert star.name == "HIP 17499, strip sky01, CCD 2" and star.key == "used" and star.printed


def test_the_middle_of_each_scene_is_that_of_its_cell_below_the_caption() -> None:
    boxes = [[-1e3, -5e2, 11e3, 85e2], [3e3, 4e3, 7e3, 5e3], [-9e3, 2e2, 1e3, 5e3], [0.0, 0.0, 5e2, 3e3]]
    west, south, east, north = np.array(boxes).T
    residual = dict.fromkeys(("residual_east_m", "residual_north_m", "residual_m"), [1.0] * 4)
    ground = {"scene": [0, 1, 2, 3], "east_m": (west + east) / 2, "north_m": (south + north) / 2} | residual
    view = view_of({f"s{n}": box for n, box in enumerate(boxes)}, ground)
    places = {spot.row.row: (spot.x, spot.y) for spot in view.spots}
    columns, _ = _layout(4, np.array([12e3, 9e3]))  # of the largest scene
    assert 1 < columns < 4
    tall = 9e3 / view.metres
    for n in range(4):
        row, column = divmod(n, columns)
        middle = (column + 0.5) * WIDTH / columns, row * (tall + CAPTION + GAP) + CAPTION + 0.5 * tall
        assert places[n] == pytest.approx(middle, abs=0.01)  # rounded


@pytest.mark.parametrize(("snr", "r"), [(0.3, 0.6), (10.0, 0.9), (251.19, 1.32), (1000.0, 1.5), (1e7, 1.5)])
def test_the_mark_of_a_star_grows_by_0_3_for_ten_times_the_signal_to_noise_ratio(snr, r):
    mark = star_detection(12.0, 7.0, snr, "used", {"used": "identified"}, "HIP 5")
    assert mark.r == pytest.approx(r, abs=1e-9)


def test_the_arrow_of_a_check_point_is_its_error_to_scale_and_points_the_right_way() -> None:
    point = SimpleNamespace(place_m=(200.0, -300.0), error_m=(4.0, -3.0), words="c")
    x, y, arrow, words = _check(point, (10.0, 20.0), 0.01, 2.5)  # type: ignore[arg-type]
    assert (x, y, words) == (12.0, 23.0, "c")  # pictures have y downwards
    dx, dy = map(float, re.match(r"M12.00 23.00l(\S+) (\S+)l", arrow).groups())  # type: ignore[union-attr]
    assert (dx, dy) == (10.0, 7.5)  # 4 m east and 3 m south at 2.5 units a metre


@pytest.mark.parametrize(("stretch", "length"), [(9.0, 45.0), (70.0, LONGEST)])  # units: of 5 m; 350 are cut
def test_an_arrow_is_cut_at_the_longest_in_its_direction_and_has_an_even_head(stretch, length) -> None:
    point = SimpleNamespace(place_m=(200.0, -300.0), error_m=(4.0, -3.0), words="c")
    _, _, arrow, _ = _check(point, (10.0, 20.0), 0.01, stretch)  # type: ignore[arg-type]
    way, left, back, right = (complex(*map(float, part.split())) for part in re.split("[lm]", arrow)[1:])
    atol = 0.01  # units: both parts are written to 0.01
    assert abs(way - length * complex(0.8, 0.6)) < atol and abs(left + back) < atol
    # seen from the arrow's direction its sides are mirrored, and point back
    one, other = (side * way.conjugate() / length for side in (left, right))
    assert abs(one - other.conjugate()) < 4 * atol and one.real < -0.2 * length


def test_angles_of_several_dumps_are_in_seconds_of_arc() -> None:
    covariance = np.diag(np.array([1e-5, 2e-5, 3e-5]) ** 2).tolist()
    content = {"theta": [4e-5, -5e-5, 6e-5], "cov": covariance}
    found = angles(content, "joint.json", "theta", "cov")
    for name, rad in (("theta", content["theta"]), ("sigma", [1e-5, 2e-5, 3e-5])):
        assert [one.exact * one.scale for one in found[name]] == pytest.approx(np.degrees(rad) * 3600.0)


def test_what_a_change_leaves_is_in_seconds_of_arc_the_one_that_helps_the_weakest_axis_most_first() -> None:
    rad = {"more stars": [2e-6, 3e-6, 9e-6], "more strips": [4e-6, 5e-6, 6e-6]}
    told = [{"change": change, "sigma_rad": one} for change, one in rad.items()]
    saved = SimpleNamespace(context={"improvements": told})
    saved.context_number = partial(Saved.context_number, saved)
    helps = _helps(saved, [SimpleNamespace(exact=x) for x in (8e-6, 8e-6, 12e-6)], 2)  # type: ignore[arg-type]
    assert {one.change: one.gain for one in helps} == pytest.approx({"more strips": 0.5, "more stars": 0.25})
    for one, change in zip(helps, ("more strips", "more stars"), strict=True):
        found = [x.exact * x.scale for x in one.sigma_arcsec]
        assert found == pytest.approx(np.degrees(rad[change]) * 3600.0)


def test_places_on_the_sky_are_those_of_the_gnomonic_projection_of_astropy() -> None:
    stars = SkyCoord([358.1, 1.4, 359.3, 0.5], [-63.5, -62.9, -65.2, -64.1], unit="deg")
    place, middle = _tangents(stars.cartesian.xyz.value.T)
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval = ("RA---TAN", "DEC--TAN"), middle
    mean, east_north = SkyCoord(stars.cartesian.mean()), wcs.all_world2pix(stars.ra.deg, stars.dec.deg, 1)
    np.testing.assert_allclose(place.T, east_north, rtol=0.0, atol=1e-11)  # degrees: rounding of radians
    np.testing.assert_allclose(middle, [mean.ra.deg, mean.dec.deg], rtol=0.0, atol=1e-11)


def test_captions_say_the_sigmas_and_the_correlation_of_their_axes() -> None:
    sigma = np.array([0.7, 2.5, 11.0])  # arcsec
    correlation = np.array([[1.0, -0.4, 0.15], [-0.4, 1.0, 0.6], [0.15, 0.6, 1.0]])
    covariance = correlation * np.outer(sigma, sigma) * np.radians(1.0 / 3600.0) ** 2
    saved = SimpleNamespace(installation={"covariance_rad2": covariance.tolist()})
    found = figures.covariance_ellipses(saved)  # type: ignore[arg-type]
    for drawing, (a, b) in zip(found, ((0, 1), (0, 2), (1, 2)), strict=True):
        names, first, second, related = re.match(
            r"(\w+): 1σ ([\d.]+)″ and ([\d.]+)″, correlation ([-+\d.]+)\.", drawing.caption
        ).groups()  # type: ignore[union-attr]
        assert names == "XYZ"[a] + "XYZ"[b]
        # four digits are written of a sigma, three decimals of a correlation
        assert [float(first), float(second)] == pytest.approx([sigma[a], sigma[b]], rel=1e-3)
        assert float(related) == pytest.approx(correlation[a, b], abs=5e-4)
        drawn = re.findall(
            r'<path d="M([^"MZm]+)" style="fill:none;stroke:var\(--ink\);stroke-width:1.4', drawing.svg
        )
        to_x, (to_y,) = scales(drawing.svg)
        for ring, sigmas in zip(drawn, (1.0, 2.4477), strict=True):
            x, y = np.array([point.split() for point in ring.split("L")], dtype=float).T
            x, y = to_x(x), to_y(y)
            farthest = sigmas * sigma[[a, b]]  # of the ellipse, at the other's regression
            np.testing.assert_allclose([x.max(), y.max()], farthest, atol=0.01 * farthest.max())
            assert y[x.argmax()] == pytest.approx(correlation[a, b] * farthest[1], abs=0.12 * farthest[1])
