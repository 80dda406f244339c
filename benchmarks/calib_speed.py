"""Speed of the information form against the literal SVD, and how cost and memory grow with the number of
frames.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/calib_speed.py
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from record import exit_status, head, peak_mib, verdict
from scipy.spatial.transform import Rotation

from boresight.calib.frames import calibrate_frames, frame_pairs, prepare_frames
from boresight.calib.ten_steps import frame_information_literally
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.vector_sets import VectorSets
from boresight.simulator.campaign import CameraPair, draw_frames, installation_by_tilt

CAMERAS = CameraPair(installation_by_tilt(np.radians(15.0)))
R_CS0 = deviation_from_theta(np.array([0.003, 0.002, 0.001])).inv() * CAMERAS.R_cs
CHUNK = 2000


def seconds(work: Callable[[], object]) -> float:
    """CPU time of a call: the least of three means over a fifth of a second."""
    means = []
    for _ in range(3):
        start, calls = time.process_time(), 0
        while (took := time.process_time() - start) < 0.2:
            work()
            calls += 1
        means.append(took / calls)
    return min(means)


def one_pass(frames: VectorSets, R_cs: Rotation) -> tuple[np.ndarray, np.ndarray]:
    return frame_pairs(prepare_frames(frames), R_cs)


def against_the_svd() -> None:
    print("one iteration, CPU time a frame; the information form works on 400 frames at once")
    print(" n_s n_c   literal SVD   information   ratio   dF relative   dtheta arcsec")
    for (stars, targets), least in {(30, 10): 200, (60, 20): 1500, (60, 40): 3000}.items():
        frames = draw_frames(400, stars, targets, 0.06, 0.3, CAMERAS, np.random.default_rng(1))
        R_cs = calibrate_frames(frames, R_CS0).R_cs
        fast = seconds(partial(one_pass, frames, R_cs)) / 400
        some = [frames.frame(k) for k in range(6)]
        slow = min(seconds(partial(frame_information_literally, *one, R_cs)) for one in some)
        F, F_theta = frame_pairs(prepare_frames(frames), R_cs)
        apart_F, apart = 0.0, 0.0
        for k, one in enumerate(some):
            literal_F, literal = frame_information_literally(*one, R_cs)
            apart_F = max(apart_F, np.abs(F[k] - literal_F).max() / np.abs(literal_F).max())
            theta = np.linalg.solve(F[k], F_theta[k]) - np.linalg.solve(literal_F, literal)
            apart = max(apart, np.abs(theta).max() / ARCSEC)
        print(
            f" {stars:3d} {targets:3d}   {1e3 * slow:8.2f} ms   {1e6 * fast:8.2f} us   {slow / fast:5.0f}"
            f"   {apart_F:11.1e}   {apart:13.1e}"
        )
        verdict(f"ratio >= {least}", slow / fast >= least)
        verdict("information to 1e-9 relative, theta to 1e-4 arcsec", apart_F < 1e-9 and apart < 1e-4)
        if (stars, targets) == (60, 20):
            whole = seconds(partial(calibrate_frames, frames, R_CS0))
            verdict(f"400 frames x (60, 20), one pass: {400e3 * fast:.1f} ms <= 20 ms", 400 * fast <= 0.020)
            verdict(f"the same from (28) to M = I: {1e3 * whole:.1f} ms <= 20 ms", whole <= 0.020)
    print()


def growth() -> None:
    print(f"growth, (60, 20) a frame, chunks of {CHUNK}; the vectors of a chunk are drawn outside the clock")
    print("  frames   CPU s   us a frame   peak MiB   1-sigma X Y Z, arcsec")
    pool = [draw_frames(CHUNK, 60, 20, 0.06, 0.3, CAMERAS, np.random.default_rng(seed)) for seed in range(4)]
    found = {}
    for n_frames in (400, 4000, 40_000, 400_000):
        start = time.process_time()
        R_cs, sigma = in_chunks(chunks(pool, n_frames))
        spent = time.process_time() - start
        found[n_frames] = (spent, peak_mib())
        sigma = sigma / ARCSEC
        print(
            f"{n_frames:8d} {spent:7.3f}   {1e6 * spent / n_frames:10.1f}   {peak_mib():8.0f}   "
            f"{sigma[0]:.5f} {sigma[1]:.5f} {sigma[2]:.5f}"
        )
        assert np.linalg.norm(theta_between(R_cs, CAMERAS.R_cs)) < 1e-5
    slope = (found[400_000][0] - found[40_000][0]) / (found[40_000][0] - found[4000][0])
    verdict(f"linear: 360 000 more frames cost {slope:.1f} times 36 000 more (9 to 11)", 9.0 <= slope <= 11.0)
    more = found[400_000][1] - found[4000][1]
    verdict(f"memory flat: {more:.0f} MiB more for 100 times the frames (<= 20)", more <= 20)


def in_chunks(parts: Iterator[VectorSets]) -> tuple[Rotation, np.ndarray]:
    """Matrix and 1-sigma (3,) rad from sets of which one chunk is held at a time.

    The first chunk alone gives a matrix; the information of all chunks is then added about it.
    """
    first = next(parts)
    reference = calibrate_frames(first, R_CS0).R_cs
    F, F_theta = one_pass(first, reference)
    F, F_theta = F.sum(axis=0), F_theta.sum(axis=0)
    for part in parts:
        more, more_theta = one_pass(part, reference)
        F, F_theta = F + more.sum(axis=0), F_theta + more_theta.sum(axis=0)
    theta = np.linalg.solve(F, F_theta)
    return deviation_from_theta(theta) * reference, np.sqrt(np.diag(np.linalg.inv(F)))


def chunks(pool: list[VectorSets], n_frames: int) -> Iterator[VectorSets]:
    """`n_frames` frames in chunks; the same few chunks come round again."""
    if n_frames < CHUNK:
        yield draw_frames(n_frames, 60, 20, 0.06, 0.3, CAMERAS, np.random.default_rng(9))
    for k in range(n_frames // CHUNK):
        yield pool[k % len(pool)]


if __name__ == "__main__":
    head("calib: speed of the information form")
    against_the_svd()
    growth()
    raise SystemExit(exit_status())
