"""Speed of the information form against the literal SVD, and how cost and memory grow with the number of
frames.

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/calib_speed.py
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import cycle

import numpy as np
from record import exit_status, head, peak_mib, verdict
from scipy.spatial.transform import Rotation

from boresight.features.paper.frames import calibrate_frames, frame_pairs, prepare_frames
from boresight.features.paper.ten_steps import frame_information_literally
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
    """Chunk by chunk, a run of 400 000 frames takes turns with ten runs of 40 000: a chunk of the same
    vectors costs 21 to 41 ms by what else uses the machine's cache and memory, for seconds at a time.
    """
    print(f"growth, (60, 20) a frame, chunks of {CHUNK}; the vectors of a chunk are drawn outside the clock")
    print("  frames   CPU s   us a frame   peak MiB   1-sigma X Y Z, arcsec")
    pool = [draw_frames(CHUNK, 60, 20, 0.06, 0.3, CAMERAS, np.random.default_rng(seed)) for seed in range(4)]
    long_s, short_s, peaks = np.zeros(200), np.zeros(200), np.zeros(200)
    long = in_chunks(pool)
    for k in range(200):
        if k % 20 == 0:
            short = in_chunks(pool)
        (R_cs, sigma), long_s[k] = clocked(long)
        _, short_s[k] = clocked(short)
        peaks[k] = peak_mib()
        if k + 1 in (2, 20, 200):
            frames, spent, (x, y, z) = (k + 1) * CHUNK, long_s[: k + 1].sum(), sigma / ARCSEC
            print(
                f"{frames:8d} {spent:7.3f}   {1e6 * spent / frames:10.1f}   {peaks[k]:8.0f}   "
                f"{x:.5f} {y:.5f} {z:.5f}"
            )
            assert np.linalg.norm(theta_between(R_cs, CAMERAS.R_cs)) < 1e-5
    slope = long_s[20:].sum() / short_s.reshape(10, 20)[:, 2:].sum(axis=1).mean()
    verdict(f"linear: 360 000 more frames cost {slope:.1f} times 36 000 more (9 to 11)", 9.0 <= slope <= 11.0)
    more = peaks[199] - peaks[1]
    verdict(f"memory flat: {more:.0f} MiB more for 100 times the frames (<= 20)", more <= 20)


def clocked(run: Iterator[tuple[Rotation, np.ndarray]]) -> tuple[tuple[Rotation, np.ndarray], float]:
    """The next result of a run and the CPU time that it took, s."""
    start = time.process_time()
    found = next(run)
    return found, time.process_time() - start


def in_chunks(pool: list[VectorSets]) -> Iterator[tuple[Rotation, np.ndarray]]:
    """Matrix and 1-sigma (3,) rad after each chunk; the same few chunks come round again.

    The first chunk alone gives a matrix; the information of all chunks is then added about it.
    """
    reference = calibrate_frames(pool[0], R_CS0).R_cs
    F, F_theta = np.zeros((3, 3)), np.zeros(3)
    for part in cycle(pool):
        more, more_theta = one_pass(part, reference)
        F, F_theta = F + more.sum(axis=0), F_theta + more_theta.sum(axis=0)
        theta = np.linalg.solve(F, F_theta)
        yield deviation_from_theta(theta) * reference, np.sqrt(np.diag(np.linalg.inv(F)))


if __name__ == "__main__":
    head("calib: speed of the information form")
    against_the_svd()
    growth()
    raise SystemExit(exit_status())
