"""Star detection, centroids, identification and camera calibration, compared with other packages: same
images, in turn, one thread, CPU time.

    python benchmarks/star_peers.py --peers-python PYTHON [--frames 8] [--attitudes 150] [--cameras 5]

The peers (the extra `peers`: seiza, tetra3rs, cedar-solve, sep, photutils; and plain OpenCV) pin other
versions than this project, so they run in an interpreter of their own, PYTHON, which this script drives; both
sides read the same files. Frames are those of star_accuracy.py. Scores are for isolated, unsaturated stars of
SNR 8 and more. The calibrations are of ten and thirty frames of star_calibration.py: tetra3rs is given the
stars that boresight found in them, whose positions are better than its own, and three rounds of solving and
calibrating, each with the camera of the one before.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
SIGMA, SIZE = 1.25, (5120, 3840)
MOST_OVER_TETRA3RS = 1.1  # CPU time of the public call over that of tetra3rs, 88 and more stars
IN_A_ROW = 20  # lists that each solver names before the next one's turn: a solver alone keeps its caches


def worker() -> None:
    """Runs in the peers' interpreter: one JSON request a line, one answer a line."""
    os.environ.setdefault("RAYON_NUM_THREADS", "1")
    tools = _peer_tools()
    print(json.dumps({name: version for name, (_, version) in tools.items()}), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        data = np.load(request["file"])
        call = tools[request["tool"]][0]
        start = time.process_time()
        answer = call(data)
        spent = 1e3 * (time.process_time() - start)
        np.save(request["answer"], np.asarray(answer, dtype=float))
        print(json.dumps({"cpu_ms": spent}), flush=True)


def _peer_tools() -> dict:
    import cv2
    import seiza
    import sep
    import tetra3rs
    from photutils.detection import DAOStarFinder

    cv2.setNumThreads(1)

    def run_seiza(image):
        stars = seiza.detect(image, max_stars=2000)
        return [(s.x, s.y) for s in seiza.refine_centroids(stars, image.astype(np.float32))]

    def centred(found):
        middle = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])
        return [(c.x + middle[0], c.y + middle[1]) for c in found.centroids]

    def run_tetra3rs(image):
        return centred(tetra3rs.extract_centroids(image, threads=1))

    def run_tetra3rs_fast(image):
        return centred(tetra3rs.extract_centroids_fast(image, threads=1))

    def run_sep(image):
        data = image.astype(np.float32)
        background = sep.Background(data, bw=256, bh=256)
        data = data - background
        found = sep.extract(data, 1.5, err=background.globalrms, minarea=5)
        x, y, _ = sep.winpos(data, found["x"], found["y"], np.full(len(found), SIGMA))
        return np.column_stack([x, y])

    def run_photutils(image):
        data = image.astype(np.float32) - np.median(image[::8, ::8])
        noise = 1.4826 * np.median(np.abs(data[::8, ::8]))
        found = DAOStarFinder(threshold=5.0 * noise, fwhm=2.355 * SIGMA)(data)
        x = found["x_centroid" if "x_centroid" in found.colnames else "xcentroid"]
        y = found["y_centroid" if "y_centroid" in found.colnames else "ycentroid"]
        return np.column_stack([x, y])

    tools = {
        "seiza detect + refine": (run_seiza, metadata.version("seiza")),
        "tetra3rs extract": (run_tetra3rs, metadata.version("tetra3rs")),
        "tetra3rs extract_fast": (run_tetra3rs_fast, metadata.version("tetra3rs")),
        "plain OpenCV, told the PSF": (_plain_opencv, metadata.version("opencv-python-headless")),
        "sep + winpos": (run_sep, metadata.version("sep")),
        "photutils DAO": (run_photutils, metadata.version("photutils")),
    }
    return tools | _peer_solvers() | _peer_calibrations()


def _plain_opencv(image):
    """Blur, threshold, components, Gaussian-window centroids with the true width."""
    import cv2

    blurred = cv2.GaussianBlur(image.astype(np.float32), (7, 7), SIGMA)
    level = float(np.median(blurred[::8, ::8]))
    noise = 1.4826 * float(np.median(np.abs(blurred[::8, ::8] - level)))
    above = (blurred > level + 5 * noise).astype(np.uint8)
    count, _, stats, middles = cv2.connectedComponentsWithStats(above)
    middles = middles[1:count][stats[1:count, cv2.CC_STAT_AREA] >= 3]
    inside = (middles > 8).all(axis=1) & (middles < np.array(SIZE) - 9).all(axis=1)
    xy = middles[inside]
    grid = np.arange(-5, 6)
    for _ in range(8):
        corner = np.rint(xy).astype(int)
        window = np.stack([image[y - 5 : y + 6, x - 5 : x + 6] for x, y in corner]).astype(float) - level
        dx, dy = corner[:, :1] + grid - xy[:, :1], corner[:, 1:] + grid - xy[:, 1:]
        weight = np.exp(-0.5 * (dx[:, None, :] ** 2 + dy[:, :, None] ** 2) / SIGMA**2) * window
        total = weight.sum(axis=(1, 2))
        step = np.column_stack(
            [(weight * dx[:, None, :]).sum(axis=(1, 2)), (weight * dy[:, :, None]).sum(axis=(1, 2))]
        )
        xy = xy + np.clip(2.0 * step / total[:, None], -1, 1)
    return xy


def _peer_solvers() -> dict:
    """Each takes (N, 2) centroids, brightest first, and gives the centre's unit vector, or nothing."""
    import tetra3
    import tetra3rs

    database = tetra3rs.SolverDatabase.generate_from_gaia(
        None, max_fov_deg=19.0, star_max_magnitude=8.0, epoch_proper_motion_year=1991.25
    )
    cedar = tetra3.Tetra3("default_database")
    middle = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2])

    def unit(ra_deg, dec_deg):
        ra, dec = np.radians([ra_deg, dec_deg])
        return [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]

    def by_tetra3rs(xy):
        found = database.solve_from_centroids(
            np.column_stack([xy - middle, np.arange(len(xy), 0, -1.0)]),
            fov_estimate_deg=18.6,
            fov_max_error_deg=0.5,
            image_shape=(SIZE[1], SIZE[0]),
        )
        return unit(found.ra_deg, found.dec_deg) if hasattr(found, "ra_deg") else []

    def by_cedar(xy):
        found = cedar.solve_from_centroids(
            xy[:, ::-1] + 0.5, (SIZE[1], SIZE[0]), fov_estimate=18.6, fov_max_error=0.5, distortion=None
        )
        return [] if found["RA"] is None else unit(found["RA"], found["Dec"])

    return {
        "tetra3rs solve": (by_tetra3rs, metadata.version("tetra3rs")),
        "cedar-solve": (by_cedar, metadata.version("cedar-solve")),
    }


def _peer_calibrations() -> dict:
    """Each takes the stars of several frames and gives the tangents that its camera has for points of a
    grid."""
    import tetra3rs

    database = tetra3rs.SolverDatabase.generate_from_gaia(
        None, max_fov_deg=19.0, star_max_magnitude=8.5, epoch_proper_motion_year=1991.25
    )
    middle, shape = np.array([(SIZE[0] - 1) / 2, (SIZE[1] - 1) / 2]), (SIZE[1], SIZE[0])

    def calibrate(data, **model):
        frames = [data[name] - [*middle, 0.0] for name in data.files if name != "grid"]
        stars = [[tetra3rs.Centroid(x=x, y=y, brightness=flux) for x, y, flux in frame] for frame in frames]
        known = {"fov_estimate_deg": 17.7, "fov_max_error_deg": 2.0}  # the nominal camera's, 5 % wrong
        for _ in range(3):
            solved = [database.solve_from_centroids(frame, image_shape=shape, **known) for frame in frames]
            camera = database.calibrate_camera(solved, stars, image_shape=shape, **model).camera_model
            known = {"camera_model": camera}
        return [camera.pixel_to_tanplane(*point) for point in data["grid"] - middle]

    models: dict = {"radial": {"model": "radial"}}
    models |= {f"order {n}": {"model": "polynomial", "order": n} for n in (3, 4, 5)}
    return {
        f"tetra3rs calibrate, {name}": (
            lambda data, model=model: calibrate(data, **model),
            metadata.version("tetra3rs"),
        )
        for name, model in models.items()
    }


class Peers:
    """The worker, as this side sees it."""

    def __init__(self, python: str, folder: Path) -> None:
        self.folder = folder
        self.process = subprocess.Popen(
            [python, __file__, "--worker"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.versions: dict[str, str] = self._answer()

    def _answer(self) -> dict:
        assert self.process.stdout is not None
        while True:
            line = self.process.stdout.readline()
            if not line:
                raise SystemExit("the peers' interpreter ended")
            if line.startswith("{"):
                return json.loads(line)

    def run(self, tool: str, file: Path) -> tuple[np.ndarray, float]:
        answer = self.folder / "answer.npy"
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"tool": tool, "file": str(file), "answer": str(answer)}) + "\n")
        self.process.stdin.flush()
        spent = self._answer()["cpu_ms"]
        return np.load(answer), spent


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peers-python", required=True)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--attitudes", type=int, default=150)
    parser.add_argument("--cameras", type=int, default=5)
    arguments = parser.parse_args()
    sys.path[:0] = [str(HERE.parent), str(HERE.parent / "tests"), str(HERE)]
    import cv2
    from record import head

    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        peers = Peers(arguments.peers_python, folder)
        head("star_id beside its peers")
        print("peers: " + ", ".join(f"{tool} {version}" for tool, version in peers.versions.items()))
        if arguments.frames:
            _finding(peers, folder, arguments.frames)
        if arguments.attitudes:
            _naming(peers, folder, arguments.attitudes)
        if arguments.cameras:
            _calibrating(peers, folder, arguments.cameras)
        peers.process.terminate()


def _finding(peers: Peers, folder: Path, frames: int) -> None:
    from frames import PAPER_CAMERA, Sensor, star_frame
    from scipy.spatial.transform import Rotation

    from boresight.star_id.catalogue import hipparcos_stars
    from boresight.star_id.finding.psf import Psf
    from boresight.star_id.finding.star_list import list_stars
    from boresight.star_id.settings import StarSettings

    places, settings, sensor = hipparcos_stars(8.0).places, StarSettings(), Sensor(hot_pixels=2000)
    tools = [tool for tool in peers.versions if not ("solve" in tool or "calibrate" in tool)]
    found: dict[str, list] = {"boresight": [], **{tool: [] for tool in tools}}
    spent: dict[str, list[float]] = {name: [] for name in found}
    truths = []
    for k in range(frames):
        rng = np.random.default_rng([2, k])
        image, truth = star_frame(PAPER_CAMERA, Rotation.random(random_state=rng), places, sensor, rng)
        np.save(folder / "image.npy", image)
        truths.append((truth.xy_px, truth.flux_dn, image))
        for tool in found:
            for _ in range(2):  # the second run counts
                if tool == "boresight":
                    start = time.process_time()
                    stars = list_stars(image, settings)
                    cost, xy = 1e3 * (time.process_time() - start), stars.xy_px
                else:
                    xy, cost = peers.run(tool, folder / "image.npy")
                if "photutils" in tool:
                    break
            found[tool].append(xy.reshape(-1, 2))
            spent[tool].append(cost)
    psf = Psf(sensor.sigma_px, sensor.sigma_px, (0.0, 0.0), *SIZE)
    print(f"\ndetection and centroids, {frames} frames; false and hot pixels taken are per frame")
    print(f"{'':30s} CPU ms  complete  x bound   false     hot")
    for tool, places_found in found.items():
        print(_score_line(tool, places_found, truths, spent[tool], psf, sensor))


def _score_line(tool, found, truths, spent, psf, sensor) -> str:
    from scipy.spatial import cKDTree

    from boresight.star_id.score import cramer_rao_px

    seen = total = false = hot = 0
    errors, bounds = [], []
    for xy, (true_xy, flux, image) in zip(found, truths):
        snr = flux / (2.02 * np.sqrt(4.0 * np.pi * (sensor.sigma_px**2 + 1 / 12)))
        tree = cKDTree(true_xy)
        alone = np.ones(len(true_xy), dtype=bool)
        for a, b in tree.query_pairs(12.5):
            alone[a] &= flux[b] < 0.002 * flux[a]
            alone[b] &= flux[a] < 0.002 * flux[b]
        inside = (true_xy > 12).all(axis=1) & (true_xy < np.array(SIZE) - 13).all(axis=1)
        rows = np.flatnonzero(alone & inside & (snr >= 8) & (flux * 0.097 < 215))
        total += len(rows)
        if len(xy) == 0:
            continue
        distance, nearest = cKDTree(xy).query(true_xy[rows])
        hit = distance < 2.5 * sensor.sigma_px
        seen += int(hit.sum())
        errors.append(xy[nearest[hit]] - true_xy[rows[hit]])
        noise = np.full(int(hit.sum()), np.sqrt(sensor.read_noise_dn**2 + 1 / 12))
        bounds.append(cramer_rao_px(true_xy[rows[hit]], flux[rows[hit]], noise, psf, sensor.e_per_dn))
        astray = tree.query(xy)[0] > 2.5 * sensor.sigma_px
        is_hot = [_lone(image, point) for point in np.rint(xy[astray]).astype(int)]
        hot += sum(is_hot)
        false += int(astray.sum()) - sum(is_hot)
    error, bound = np.vstack(errors), np.concatenate(bounds)
    over = np.sqrt((0.5 * (error**2).sum(axis=1) / bound**2).mean())
    n = len(found)
    figures = f"{seen / total:8.4f}  {over:7.3f}  {false / n:6.1f}  {hot / n:6.1f}"
    return f"{tool:30s} {np.median(spent):6.1f}  {figures}"


def _lone(image, point) -> bool:
    x, y = point
    window = image[max(0, y - 2) : y + 3, max(0, x - 2) : x + 3].astype(float)
    return bool(window.size >= 9 and window.max() - np.sort(window.ravel())[-2] > 15.0)


def _centroids(camera, R_si, places, rng, stars: int, false: int):
    """The brightest stars in view with the noise of their brightness, and false ones among them; brightest
    first."""
    from frames import stars_in_view

    rows, xy = stars_in_view(camera, R_si, places)
    order = np.argsort(places.v_mag[rows], kind="stable")[:stars]
    v = places.v_mag[rows[order]] + rng.normal(0, 0.1, len(order))
    sigma = np.clip(1.77 / (8.0 * 10 ** (-0.4 * (v - 7.0))), 0.01, 0.3)
    xy = xy[order] + rng.normal(size=(len(order), 2)) * sigma[:, None]
    xy = np.vstack([xy, rng.uniform([0, 0], np.array(SIZE) - 1, (false, 2))])
    sigma = np.append(sigma, np.full(false, 0.2))
    order = np.argsort(np.append(v, rng.choice(v, false)), kind="stable")
    return xy[order], sigma[order]


def _naming(peers: Peers, folder: Path, attitudes: int) -> None:
    from dataclasses import replace

    from frames import PAPER_CAMERA
    from record import verdict
    from rendered_sequences import places_of
    from scipy.spatial.transform import Rotation

    from boresight.features.sky_images.identify_images import sky_index
    from boresight.star_id.settings import StarSettings

    camera = replace(PAPER_CAMERA, p1=0.0, p2=0.0, q1=0.0, q2=0.0, principal_px=(2559.5, 1919.5))
    places = places_of(sky_index(camera, None, StarSettings()))  # where stars are today
    print(
        f"\nnaming, {attitudes} attitudes a scenario, field of view known; error of the centre, arc-seconds\n"
        "boresight: the public call, identify(Stars, camera=camera), with attitude, and covariances;"
        f" solvers in turn, {IN_A_ROW} lists each"
    )
    print(f"{'':44s} CPU ms  right  wrong  error")
    ratios = {}
    for title, stars, false in (
        ("138 stars", 138, 0),
        ("88 stars", 88, 0),
        ("138 stars, 50 false", 138, 50),
        ("138 stars, 200 false", 138, 200),
        ("8 stars, 3 false", 8, 3),
    ):
        names = ("boresight", "tetra3rs solve", "cedar-solve")
        score: dict[str, list] = {name: [0, 0, [], []] for name in names}
        lists, centres = [], []
        for k in range(attitudes):
            rng = np.random.default_rng([3, k])
            R_si = Rotation.random(random_state=rng)
            lists.append(_centroids(camera, R_si, places, rng, stars, false))
            np.save(folder / f"centroids{k}.npy", lists[-1][0])
            centres.append(R_si.inv().apply([0.0, 0.0, 1.0]))
        for first in range(0, attitudes, IN_A_ROW):
            for name, entry in score.items():
                for k in range(first, min(first + IN_A_ROW, attitudes)):
                    if name == "boresight":
                        pointing, cost = _named(camera, *lists[k])
                    else:
                        pointing, cost = peers.run(name, folder / f"centroids{k}.npy")
                    entry[3].append(cost)
                    if pointing.size == 3:
                        miss = np.linalg.norm(pointing - centres[k]) * 206265.0
                        entry[0] += miss < 120.0
                        entry[1] += miss >= 120.0
                        entry[2].append(miss)
        for name, (right, wrong, misses, costs) in score.items():
            middle = np.median(misses) if misses else np.nan
            print(f"{title:26s}{name:18s} {np.median(costs):6.2f}  {right:5d}  {wrong:5d}  {middle:5.2f}")
        ratios[title] = np.median(score["boresight"][3]) / np.median(score["tetra3rs solve"][3])
    for title, ratio in ratios.items():
        if not title.startswith("8 "):
            text = f"{title}: CPU over that of tetra3rs {ratio:.2f}, at most {MOST_OVER_TETRA3RS:.2f}"
            verdict(text, ratio <= MOST_OVER_TETRA3RS)


def _named(camera, xy, sigma):
    """Direction of the axis, empty where not identified, and the CPU time of the public call, ms."""
    import boresight as bs

    stars = _as_found(camera, xy, sigma)
    start = time.process_time()
    found = bs.identify(stars, camera=camera)
    cost = 1e3 * (time.process_time() - start)
    return (found.R_si.inv().apply([0.0, 0.0, 1.0]) if found else np.empty(0)), cost


def _as_found(camera, xy, sigma):
    """Centroids (N, 2) and their errors (N,), px, as `find_stars` gives them."""
    from dataclasses import replace

    cov, no, flux = sigma[:, None, None] ** 2 * np.eye(2), np.zeros(len(xy), dtype=bool), 1e3 / sigma
    columns = {"xy_px": xy, "cov_px": cov, "flux_dn": flux, "snr": 1.0 / sigma}
    columns |= {"saturated": no, "blended": no, "misshapen_px": np.zeros((0, 2))}
    blank = _blank()
    listed = replace(blank.star_list, **columns, psf_stars=len(xy))
    return replace(blank, **columns, size_px=(camera.width_px, camera.height_px), star_list=listed)


@cache
def _blank():
    """What `find_stars` says of an image of noise."""
    import boresight as bs

    return bs.find_stars(np.random.default_rng(1).normal(20.0, 2.0, (64, 64)).astype(np.uint8))


def _calibrating(peers: Peers, folder: Path, cameras: int) -> None:
    from star_calibration import NOMINAL, detector, errors_of_map, sky_frame

    from boresight.star_id.camera_calibration import calibrate_camera
    from boresight.star_id.catalogue import hipparcos_stars
    from boresight.star_id.identification.triangle_index import build_index
    from boresight.star_id.settings import StarSettings

    places, settings = hipparcos_stars(8.0).places, StarSettings()
    index = build_index(places, places.epoch_jyear, (np.radians(15.0), np.radians(24.0)))
    tools = ["boresight", *(tool for tool in peers.versions if "calibrate" in tool)]
    score: dict = {(tool, count): [] for tool in tools for count in (10, 30)}
    for seed in range(1, cameras + 1):
        seen = [sky_frame(places, np.random.default_rng([seed, k]), k, settings)[0] for k in range(30)]
        for frames in (seen[:10], seen[10:20], seen[20:], seen):
            stars = {
                f"{k:02d}": np.column_stack([f.stars.xy_px, f.stars.flux_dn]) for k, f in enumerate(frames)
            }
            np.savez(folder / "stars.npz", grid=detector(), **stars)
            for tool in tools:
                if tool == "boresight":
                    start = time.process_time()
                    camera = calibrate_camera(frames, NOMINAL, index, settings).camera
                    cost = 1e3 * (time.process_time() - start)
                    u_s = camera.directions_from_pixels(detector())
                else:
                    tangents, cost = peers.run(tool, folder / "stars.npz")
                    u_s = np.column_stack([-tangents, np.ones(len(tangents))])
                    u_s /= np.linalg.norm(u_s, axis=1)[:, None]
                error = errors_of_map(u_s)
                largest = np.hypot(*error.T).max()
                score[tool, len(frames)].append((np.sqrt((error**2).mean()), largest, cost))
    print(
        f"\ncalibrating, {3 * cameras} sets of 10 frames, {cameras} of 30; median error of the pixel map, px"
    )
    print(f"{'':30s} 10 frames: rms  largest  CPU ms   30 frames: rms  largest  CPU ms")
    for tool in tools:
        ten, thirty = (
            "{:14.4f}  {:7.3f}  {:6.0f}".format(*np.median(score[tool, count], axis=0)) for count in (10, 30)
        )
        print(f"{tool:30s} {ten}   {thirty}", flush=True)


if __name__ == "__main__":
    worker() if "--worker" in sys.argv else main()
    from record import exit_status

    raise SystemExit(exit_status())
