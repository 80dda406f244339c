"""Stars as bad sensors, lenses and skies show them: found, measured, identified, and how honest the stated
errors are; beside peers on the same images.

    python benchmarks/star_hard.py [--frames 4] [--only NAME ...] [--peers-python PYTHON]

Frames are rendered by `hard_frames.py`: 2048 x 2048 px, 12 deg, unless a row says otherwise; every frame of a
row shows another part of the sky. `unknown` is the image alone, `given` the true camera with it. Columns:

    right      identified within 0.05 deg and 0.2 deg of roll: of frames; w: identified wrongly
    complete   of the isolated, unsaturated stars of SNR 8 and more (matched filter of the rendered PSF)
    false      detections without a star within 3 px, or a third of a trail's length, a frame
    x bound    error of these stars over the Cramér-Rao bound of the rendered PSF, and chi2 of their errors,
               1 if their covariances are correct: means without the largest hundredth, over what these are
               expected to be (`_robust_mean`); of JPEG over the bound of the compressed frame, whose
               coefficients are normal variables rounded to the steps of the file's own table
    NEES       mean squared error over stated variance, each of one degree of freedom: direction, roll, field;
               a verdict is on all rows together, and with 20 frames and more on each: 0.7 to 1.4, times the
               scatter of correct means where squares are few
    CPU        ms a frame for an image alone, detection to fit

Peers (the extra `peers`; seiza is not among them: it identifies no stars without data of its own to be
downloaded) run in an interpreter of their own and know the field of view to 10 %.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from hard_peers import Peers
from numpy.typing import NDArray
from record import ROOT, exit_status, head, judge_largest, judge_share, verdict
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, expon

sys.path.insert(0, str(ROOT / "tests"))
sys.path.insert(0, str(ROOT / "tests" / "star_id"))

from frames import stars_in_view
from hard_frames import (
    Blur,
    Sensor,
    Stars,
    bound_after_jpeg_px,
    cramer_rao_px,
    fan_at,
    psf_table,
    render,
    response,
)

from boresight.geometry.star_camera import StarCamera
from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.field import FieldSolution, solve_list
from boresight.star_id.finding.star_list import StarList, list_stars
from boresight.star_id.identification.triangle_index import StarIndex, build_index
from boresight.star_id.settings import StarSettings

LEAST_SNR, NEAR_PX, ALONE_PX = 8.0, 3.0, 16.0
CUT = 0.01  # share of the errors of places, the largest, that no mean has


SHARP, USUAL = Blur(), Sensor(hot_pixels=200)
BAD = Sensor(hot_columns=20, row_noise=0.3, vignetting=0.5)


@dataclass(frozen=True)
class Row:
    """One condition."""

    name: str
    blur: Blur = SHARP
    sensor: Sensor = USUAL
    fov_deg: float = 12.0
    side_px: int = 2048
    electrons_at_v7: float = 1600.0  # SNR 8 for the undisturbed PSF and sky is V = 8.6
    missing: float = 0.0
    mirrored: bool = False
    starless: bool = False
    centroids: int = 0  # stars of a list without image
    false: int = 0
    complete: float = 0.95
    over_bound: float = 1.1  # of centroids, at most; in compressed frames over the bound of these
    as_stated: bool = False  # whether chi2 of the places must be 1 to a tenth
    shutter_px: float = 0.0  # motion while rows are read one after another, in any direction


ROWS = (
    Row("clean", as_stated=True),
    Row("20 hot columns, row noise, vignetting", sensor=BAD),
    Row(
        "20 hot columns, 8 bits, 20 deg",
        sensor=replace(BAD, bits=8, bias_dn=16.0),
        fov_deg=20.0,
        complete=0.85,  # the list ends with 600 stars
    ),
    Row(
        "3 hot columns, 8 bits, 15 deg",
        sensor=replace(BAD, bits=8, bias_dn=16.0, hot_columns=3),
        fov_deg=15.0,
        complete=0.85,
    ),
    Row(
        "10 hot columns, 8 bits, 25 deg",
        sensor=replace(BAD, bits=8, bias_dn=16.0, hot_columns=10),
        fov_deg=25.0,
        complete=0.6,  # the list ends with 600 stars
    ),
    Row("1 % hot, dead rows, PRNU of 10 %", sensor=Sensor(hot_pixels=41943, dead_rows=8, prnu=0.1)),
    Row("gamma 2.2, 8 bits", sensor=Sensor(bits=8, bias_dn=16.0, gamma=2.2)),
    Row("row noise of 0.75 sigma", sensor=Sensor(row_noise=0.75)),
    Row("sky clipped at zero", sensor=Sensor(clipped=True)),
    Row("columns, rows, clipped", sensor=replace(BAD, vignetting=0.15, clipped=True)),
    Row("half of the stars missing", missing=0.5),
    Row("ring of radius 3 px", blur=Blur(ring_px=3.0), complete=0.9),
    Row("ring of radius 4 px", blur=Blur(ring_px=4.0), complete=0.9),
    Row("trail of 10 px", blur=Blur(trail_px=(9.1, -4.2)), complete=0.9),
    Row("trail of 15 px", blur=Blur(trail_px=(4.0, 14.5)), complete=0.9),
    Row("trail of 20 px", blur=Blur(trail_px=(17.3, 10.0)), complete=0.9),
    Row("coma of 6 px in the corners", blur=Blur(coma_px=6.0), complete=0.9),
    Row("mirrored", mirrored=True),
    Row("caption of 5 % of the rows", sensor=Sensor(caption=True)),
    Row("Bayer mosaic", sensor=Sensor(bayer=(0.45, 1.0, 1.0, 0.6)), electrons_at_v7=1900.0, complete=0.9),
    Row("6 deg, faint, hot pixels", sensor=Sensor(hot_pixels=3000, cosmic_rays=100), fov_deg=6.0),
    Row("nebula", sensor=Sensor(nebula_e=300.0), fov_deg=9.0),
    Row("50 deg, 0 false of 120", centroids=120, fov_deg=50.0),
    Row("50 deg, 300 false faint of 420", centroids=120, false=300, fov_deg=50.0),
    Row("50 deg, 400 false faint of 520", centroids=120, false=400, fov_deg=50.0),
    Row("12 deg, 300 false of 400", centroids=100, false=300),
    Row("no star, noise", starless=True),
    Row("no star, hot pixels and rays", sensor=Sensor(hot_pixels=3000, cosmic_rays=300), starless=True),
    Row("no star, columns and rows", sensor=BAD, starless=True),
    Row("8 bits", sensor=Sensor(bits=8, e_per_dn=25.0, bias_dn=16.0), as_stated=True),
    Row("JPEG quality 70", sensor=Sensor(bits=8, bias_dn=16.0, jpeg=70), complete=0.9, over_bound=1.15),
    Row("JPEG quality 40", sensor=Sensor(bits=8, bias_dn=16.0, jpeg=40), complete=0.9, over_bound=1.15),
    Row("rolling shutter of 0.1 px", shutter_px=0.1),
    Row("rolling shutter of 1 px", shutter_px=1.0),
    Row("rolling shutter of 3 px", shutter_px=3.0),
    Row("16 bits", sensor=Sensor(bits=16, e_per_dn=0.6, bias_dn=800.0), as_stated=True),
)


@dataclass
class Score:
    """Sums over the frames of one row."""

    right: dict[str, int] = field(default_factory=dict)
    wrong: dict[str, int] = field(default_factory=dict)
    nees: dict[str, list[NDArray]] = field(default_factory=dict)
    seen: int = 0
    stars: int = 0
    false: int = 0
    over: list[NDArray] = field(default_factory=list)
    chi2: list[NDArray] = field(default_factory=list)
    cpu_ms: list[float] = field(default_factory=list)

    def count(self, name: str, right: bool | None) -> None:
        """An answer of `name`: right, wrong or none."""
        self.right[name] = self.right.get(name, 0) + (right is True)
        self.wrong[name] = self.wrong.get(name, 0) + (right is False)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--only", nargs="+", default=[], help="rows whose name contains one of these")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--peers-python")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    places = hipparcos_stars(8.0).places
    index = build_index(places, places.epoch_jyear, (np.radians(5.0), np.radians(60.0)))
    head("star_id on hard frames")
    rows = [row for row in ROWS if not arguments.only or any(part in row.name for part in arguments.only)]
    with tempfile.TemporaryDirectory() as folder:
        peers = Peers(arguments.peers_python, Path(folder)) if arguments.peers_python else None
        names = peers.names if peers else []
        print(f"{'':38s} right of {arguments.frames}" + " " * (10 * len(names) + 9), end="")
        print("complete  false  x bound  chi2    NEES unknown        NEES given      CPU")
        print(f"{'':38s}  unknown    given" + "".join(f"{name:>12s}" for name in names), end="")
        print(" " * 36 + "dir   roll  field    dir   roll   ms")
        whole: dict[str, list[NDArray]] = {"unknown": [], "given": []}
        for row in rows:
            score = Score()
            for k in range(arguments.frames):
                rng = np.random.default_rng([arguments.seed, *row.name.encode(), k])
                _frame(row, rng, places, index, score, peers)
            _print(row, score, names)
            _verdicts(row, score, names)
            for name, nees in score.nees.items():
                whole[name].extend(nees)
    for name, nees in whole.items():
        for what, mean in zip(("direction", "roll", "field"), _means(nees)):
            if np.isfinite(mean):
                text = f"all rows, camera {name}: NEES of {what} {mean:.2f}"
                _judge_nees(text, float(mean), len(nees) * (2 if what == "direction" else 1))


def _camera(row: Row, rng: np.random.Generator) -> StarCamera:
    """A lens whose corners are displaced by up to 2.5 %, its axis up to 0.5 % of the width off the middle."""
    focal_px = 0.5 * row.side_px / np.tan(0.5 * np.radians(row.fov_deg))
    pixel_m = 5e-6
    f_mm, middle = 1e3 * focal_px * pixel_m, 0.5 * (row.side_px - 1)
    corner = np.tan(0.5 * np.radians(row.fov_deg)) * np.sqrt(2.0) * f_mm
    x0, y0 = middle + 0.005 * row.side_px * rng.uniform(-1.0, 1.0, 2)
    return StarCamera(
        focal_m=1e-3 * f_mm,
        pixel_m=pixel_m,
        width_px=row.side_px,
        height_px=row.side_px,
        principal_px=(float(x0), float(y0)),
        q1=0.025 * rng.uniform(-1.0, 1.0) / corner**2,
        p1=0.001 * rng.uniform(-1.0, 1.0) / corner,
        p2=0.001 * rng.uniform(-1.0, 1.0) / corner,
    )


def _frame(row: Row, rng, places, index: StarIndex, score: Score, peers: Peers | None) -> None:
    camera, R_si = _camera(row, rng), Rotation.random(random_state=rng)
    sky = _sky(row, camera, R_si, places, rng)
    settings = StarSettings()
    size = (row.side_px, row.side_px)
    if row.centroids:
        data, stars = _list(row, sky, rng)
    else:
        data, variance = render(sky, size, row.blur, row.sensor, rng)
        if row.mirrored:
            data = np.ascontiguousarray(data[:, ::-1])
    start = time.process_time()
    if not row.centroids:
        stars = list_stars(data, settings)
    unknown = solve_list(stars, size, index, settings)
    score.cpu_ms.append(1e3 * (time.process_time() - start))
    given = solve_list(stars, size, index, settings, camera=camera)
    for name, answer in (("unknown", unknown), ("given", given)):
        error = _errors(answer, camera, R_si, row.mirrored)
        score.count(name, None if error is None else error[0])
        if error is not None and error[0]:
            score.nees.setdefault(name, []).append(error[1])
    if not row.centroids and not row.starless:
        _score_stars(row, stars, sky, variance, score)
    if peers is not None:
        np.save(peers.file, np.vstack([[size], stars.xy_px]) if row.centroids else data)
        middle = R_si.inv().apply(camera.directions_from_pixels([[0.5 * (s - 1) for s in size]]))[0]
        for name in peers.names:
            at = peers.run(name, row.fov_deg)
            score.count(name, None if at is None else bool(_unit(*np.radians(at)) @ middle > np.cos(0.002)))


def _unit(ra: float, dec: float) -> NDArray:
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def _sky(row: Row, camera: StarCamera, R_si: Rotation, places, rng) -> Stars:
    """Stars of the catalogue, and uniform fainter ones, 2.9 times as many for each magnitude to V = 11."""
    if row.starless:
        return Stars()
    rows, xy = stars_in_view(camera, R_si, places)
    v = places.v_mag[rows]
    extra = rng.poisson(len(rows) * (2.9**3 - 1))
    fainter = 8.0 + np.log(1.0 + rng.random(extra) * (2.9**3 - 1.0)) / np.log(2.9)
    if row.missing:
        keep = rng.random(len(rows)) >= row.missing
        rows, xy, v = rows[keep], xy[keep], v[keep]
    corners = np.array([-0.5, row.side_px - 0.5])
    xy = np.vstack([xy, rng.uniform(*corners, (extra, 2))])
    if row.shutter_px:  # the attitude is that of the middle row's instant
        angle = rng.uniform(0.0, 2.0 * np.pi)
        moved = row.shutter_px * np.array([np.cos(angle), np.sin(angle)])
        xy = xy + (xy[:, 1:] / (row.side_px - 1) - 0.5) * moved
    electrons = row.electrons_at_v7 * 10.0 ** (-0.4 * (np.append(v, fainter) - 7.0))
    return Stars(xy, electrons)


def _list(row: Row, sky: Stars, rng) -> tuple[NDArray, StarList]:
    """Centroids as from a detector: the brightest stars with errors as their SNR makes them, and false faint
    ones, spread evenly, as faint as the fainter half of the stars."""
    bright = np.argsort(-sky.electrons, kind="stable")[: row.centroids]
    flux = sky.electrons[bright] * rng.normal(1.0, 0.1, row.centroids).clip(0.5)
    faint = np.sort(flux)[: row.centroids // 2]
    flux = np.append(flux, rng.choice(faint, row.false))
    snr = 6.0 * flux / flux.min()
    sigma = np.maximum(1.1 / snr, 0.01)
    xy = np.vstack([sky.xy_px[bright], rng.uniform(0, row.side_px - 1, (row.false, 2))])
    xy[: row.centroids] += rng.normal(size=(row.centroids, 2)) * sigma[: row.centroids, None]
    order = np.argsort(-flux, kind="stable")
    blank = list_stars(rng.normal(100.0, 2.0, (64, 64)).astype(np.float32), StarSettings())
    no = np.zeros(len(order), dtype=bool)
    stars = replace(
        blank,
        xy_px=xy[order],
        cov_px=sigma[order, None, None] ** 2 * np.eye(2),
        flux_dn=flux[order],
        snr=snr[order],
        saturated=no,
        blended=no,
    )
    return xy, stars


def _errors(answer, camera: StarCamera, R_si: Rotation, mirrored: bool) -> tuple[bool, NDArray] | None:
    """Whether an answer is right, and its squared normalised errors (4,): two of direction, roll, field."""
    if not isinstance(answer, FieldSolution):
        return None
    found = answer.R_si.inv().as_matrix() @ answer.camera.middle_axes()
    true = R_si.inv().as_matrix() @ camera.middle_axes()
    delta = Rotation.from_matrix(found.T @ true).as_rotvec()
    right = answer.mirrored == mirrored and bool(
        np.hypot(*delta[:2]) < np.radians(0.05) and abs(delta[2]) < np.radians(0.2)
    )
    axes = answer.camera.middle_axes()
    sigma = np.sqrt(np.diag(axes.T @ answer.cov_s @ axes)) if answer.cov_s is not None else np.full(3, np.nan)
    off = (answer.fov_x_rad - camera.fov_x_rad) / (answer.fov_x_sigma_rad or np.nan)
    return right, np.append(delta / sigma, off) ** 2


def _score_stars(row: Row, stars: StarList, sky: Stars, variance: NDArray, score: Score) -> None:
    """Completeness, false detections and errors over the bound of isolated stars."""
    size = row.side_px
    xy = sky.xy_px * [-1, 1] + [size - 1, 0] if row.mirrored else sky.xy_px
    tree, seen = cKDTree(xy), sky.electrons
    bright = np.flatnonzero(seen > 0.12 * row.electrons_at_v7)
    pairs = tree.query_pairs(ALONE_PX if not any(row.blur.trail_px) else 28.0, output_type="ndarray")
    alone = np.ones(len(xy), dtype=bool)
    for a, b in (pairs.T, pairs.T[::-1]):
        alone[a[seen[b] > 0.002 * seen[a]]] = False
    inside = ((xy > 20) & (xy < size - 21)).all(axis=1)
    if row.sensor.caption:
        inside &= xy[:, 1] < 0.95 * size - 20
    rows = np.intersect1d(np.flatnonzero(alone & inside), bright)
    bound, snr = _bound(row, sky.xy_px[rows], seen[rows], variance)
    if row.sensor.jpeg:
        table = psf_table(row.blur)
        bound = bound_after_jpeg_px(sky.xy_px[rows], seen[rows], variance, row.sensor, table)
    peak = seen[rows] / row.sensor.e_per_dn * 0.15 + row.sensor.bias_dn < 0.9 * 2**row.sensor.bits
    use = (snr >= LEAST_SNR) & peak
    if len(stars.xy_px):
        distance, nearest = cKDTree(stars.xy_px).query(xy[rows])
        near = max(NEAR_PX, float(np.hypot(*row.blur.trail_px)) / 3.0, row.blur.ring_px)
        hit = use & (distance < near)
        error = stars.xy_px[nearest[hit]] - xy[rows[hit]]
        normalised = np.linalg.solve(stars.cov_px[nearest[hit]], error[:, :, None])[:, :, 0]
        score.seen += int(hit.sum())
        score.over.append(0.5 * (error**2).sum(axis=1) / bound[hit] ** 2)
        score.chi2.append(0.5 * (error * normalised).sum(axis=1))
        score.false += int((tree.query(stars.xy_px)[0] > near).sum())
    score.stars += int(use.sum())


def _bound(row: Row, xy: NDArray, electrons: NDArray, variance: NDArray) -> tuple[NDArray, NDArray]:
    cells = 9 if row.blur.coma_px else 1
    cell = np.clip((xy / row.side_px * cells).astype(int), 0, cells - 1)
    share = response(row.sensor, (row.side_px, row.side_px))
    answer = np.empty((len(xy), 2))
    for i, j in np.unique(cell, axis=0):
        here = (cell == [i, j]).all(axis=1)
        table = psf_table(row.blur, fan_at(np.array([i, j]), cells))
        uneven = row.sensor.prnu, row.sensor.sky_e
        answer[here] = cramer_rao_px(xy[here], electrons[here], variance, share, table, *uneven)
    return answer[:, 0], answer[:, 1]


def _robust_mean(parts: list[NDArray]) -> float:
    """Mean without the largest hundredth, over what it is expected to be of halved squares of two normal
    errors: 0.954. A hot pixel or a blend beside a star is no error of the method; without such, the hundredth
    is the tail of correct errors."""
    every = np.sort(np.concatenate(parts)) if parts else np.array([np.nan])
    kept = max(1, int(np.ceil((1.0 - CUT) * len(every))))
    most = expon.ppf(1.0 - CUT)
    return float(every[:kept].mean() / expon.expect(ub=most, conditional=True))


def _means(nees: list[NDArray] | None) -> NDArray:
    """(3,) means of the squared normalised errors: direction, roll, field."""
    if not nees:
        return np.full(3, np.nan)
    each = np.array(nees)
    return np.array([each[:, :2].mean(), each[:, 2].mean(), each[:, 3].mean()])


def _print(row: Row, score: Score, names: list[str]) -> None:
    cells = []
    for name in ("unknown", "given", *names):
        wrong = f"w{score.wrong[name]}" if score.wrong[name] else "  "
        cells.append(f"{score.right[name]:>7d}{wrong:2s}" + " " * (3 if name in names else 0))
    text = f"{row.name:38s}" + "".join(cells)
    if score.stars:
        over = np.sqrt(_robust_mean(score.over))
        text += f"{score.seen / score.stars:9.3f} {score.false / len(score.cpu_ms):6.1f} {over:8.2f}"
        text += f" {_robust_mean(score.chi2):6.2f}"
    else:
        text += " " * 32
    (d, r, f), (d2, r2, _) = _means(score.nees.get("unknown")), _means(score.nees.get("given"))
    text += f"  {d:6.2f} {r:6.2f} {f:6.2f}  {d2:6.2f} {r2:6.2f} {np.median(score.cpu_ms):6.0f}"
    print(text, flush=True)


def _verdicts(row: Row, score: Score, names: list[str]) -> None:
    frames, wrong = len(score.cpu_ms), score.wrong["unknown"] + score.wrong["given"]
    if row.starless:
        named = score.right["unknown"] + score.right["given"] + wrong
        judge_share(f"{row.name}: identified", named, 2 * frames, most=0.0)
        judge_largest(f"{row.name}: median", np.median(score.cpu_ms), 500.0, "ms CPU", frames)
        return
    judge_share(f"{row.name}: identified wrongly", wrong, 2 * frames, most=0.0)
    best = max((score.right[name] for name in names), default=0)
    right = (
        f"{row.name}: {score.right['unknown']} of {frames} identified, {score.right['given']} with the camera"
    )
    asked = f"as often as the best peer, {best}" if names else "with the camera no fewer"
    least = score.right["given"] >= score.right["unknown"] >= best
    verdict(right, asked, least, frames)
    if score.stars:
        n = score.seen
        judge_share(f"{row.name}: stars found", n, score.stars, least=row.complete)
        most = 2.0 + (3.3 * np.sqrt(2.0 / frames) if frames < 20 else 0.0)
        judge_largest(
            f"{row.name}: false detections a frame", score.false / frames, round(most, 2), "", frames
        )
        over, found = float(np.sqrt(_robust_mean(score.over))), _robust_mean(score.chi2)
        most = row.over_bound + 1.65 / np.sqrt(n)
        judge_largest(f"{row.name}: centroids over their bound", over, round(most, 3), "", n)
        scatter = 3.3 / np.sqrt(n)
        low, high = (0.9 - scatter if row.as_stated else 0.0), (1.1 if row.as_stated else 1.4) + scatter
        text = f"{row.name}: chi2 of places {found:.2f}"
        verdict(text, f"{low:.2f} to {high:.2f}", low <= found <= high, n)
    for name in ("unknown", "given") if frames >= 20 else ():
        for what, mean in zip(("direction", "roll", "field"), _means(score.nees.get(name))):
            if np.isfinite(mean):
                dof = score.right[name] * (2 if what == "direction" else 1)
                _judge_nees(f"{row.name}, camera {name}: NEES of {what} {mean:.2f}", float(mean), dof)


def _judge_nees(text: str, mean: float, dof: int) -> None:
    """Verdict of a mean of `dof` squares: 0.7 to 1.4, times their scatter where they are too few for that."""
    scatter = chi2.ppf([0.025, 0.975], dof) / dof
    low, high = 0.7, 1.4
    if scatter[0] < low or scatter[1] > high:
        low, high = low * scatter[0], high * scatter[1]
    verdict(text, f"{low:.2f} to {high:.2f}", low <= mean <= high, dof)


if __name__ == "__main__":
    main()
    raise SystemExit(exit_status())
