"""Every numbered equation of the paper: the function that carries it out against the equation written out, or
against an outside authority (OpenCV, SciPy's matrix exponential).

Each function of `GROUPS` hands what it finds to `shown`: number, what differs, the largest difference, its
limit and unit. `test_equations.py` asks for all limits, `benchmarks/paper_tables.py` makes a record of them.
"""

from collections.abc import Callable

import cv2
import numpy as np
import scipy.linalg
from scipy.spatial.transform import Rotation
from strips import R_CS, strip
from ten_steps import frame_information_literally

from boresight.calib.information import solve_total
from boresight.features.exports.virtual_ccd import virtual_camera
from boresight.features.paper.frames import calibrate_frames, frame_pairs, prepare_frames
from boresight.geometry.attitude_estimate import fit_attitudes
from boresight.geometry.constants import ARCSEC
from boresight.geometry.installation import deviation_from_theta, theta_between
from boresight.geometry.sightings import information_of_directions, isotropic_covariance
from boresight.simulator.cameras import calibrated_line_camera, star_camera
from boresight.simulator.campaign import CameraPair, draw_frames, noisy_frames
from boresight.simulator.scenario import paper_scenario

Shown = Callable[..., None]  # number, what, difference, limit, unit
N_S, N_C, DRAWS = 20, 8, 4000
THETA = np.array([0.003, 0.002, 0.001])  # rad, (28)
R_CS0 = deviation_from_theta(THETA).inv() * Rotation.from_euler("xyz", [40, -65, 110], degrees=True)
CAMERAS = CameraPair(deviation_from_theta(THETA) * R_CS0)
M = CAMERAS.R_cs.as_matrix() @ R_CS0.as_matrix().T


def bracket(v: np.ndarray) -> np.ndarray:
    """The paper's [[v]], below (12)."""
    x, y, z = v
    return np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])


def largest(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(np.asarray(a) - np.asarray(b)).max())


def cameras_and_directions(rng: np.random.Generator, shown: Shown) -> None:
    model = strip()
    sample, line = rng.uniform(0.0, 6143.0, 200), rng.uniform(0.0, 26000.0, 200)
    look_i, t_s = model.look_i(0, sample, line)
    literal = R_CS.as_matrix() @ model.attitude.R_si(t_s).as_matrix()  # (2)
    reach = rng.uniform(5e5, 6e5, 200)
    seen = np.einsum("nab,nb->na", literal, reach[:, None] * look_i)  # M (X - X_P)
    camera = model.camera
    scale = -camera.focal_m / seen[:, 2]  # lambda, from the third row
    image = camera.ccds[0].focal_plane(sample)
    shown("1", "row 2 of the collinearity equation, largest lambda < 0", float(scale.max()), 0.0)
    apart = largest(scale[:, None] * seen[:, :2], image) / 1e-5
    shown("1", "image points by lambda M (X - X_P)", apart, 1e-6, " px")
    u_c = camera.directions_from_pixels(0, sample)
    shown("2", "look vectors through M = R_cs R_si", largest(seen / reach[:, None], u_c), 1e-14)
    ra, dec = rng.uniform(0.0, 2 * np.pi, 30), rng.uniform(-1.5, 1.5, 30)
    v = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    R_si = Rotation.random(rng=rng)
    u = v @ R_si.as_matrix().T
    found = fit_attitudes(u, v, isotropic_covariance(u, 1e-6), np.array([0, len(u)])).R_si[0]
    shown("3", "u = R_si v with the attitude fitted to u and v", largest(u, v @ found.T), 1e-12)
    star_camera_and_distortion(rng, shown)


def star_camera_and_distortion(rng: np.random.Generator, shown: Shown) -> None:
    s = paper_scenario().star_camera
    camera = star_camera(s)
    xy_mm = rng.uniform(-1.0, 1.0, (500, 2)) * [16.384, 12.288]
    x, y = xy_mm.T
    r2 = x**2 + y**2  # (6)
    dx = x * (s.q1 * r2 + s.q2 * r2**2) + s.p1 * (r2 + 2 * x**2) + 2 * s.p2 * x * y  # (5)
    dy = y * (s.q1 * r2 + s.q2 * r2**2) + s.p2 * (r2 + 2 * y**2) + 2 * s.p1 * x * y
    actual = xy_mm + np.column_stack([dx, dy])  # (4)
    u = np.column_stack([-x, -y, np.full(500, s.focal_mm)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    measured_px = np.array(s.principal_px) + actual / (s.pixel_um * 1e-3)
    apart = largest(camera.directions_from_pixels(measured_px), u)
    shown("3", "u of image points without distortion", apart, 1e-13)
    away = largest(camera.pixels_from_directions(u), measured_px)
    shown("4", "image points with distortion", away, 1e-9, " px")
    lens = camera.opencv_parameters()
    v_cv = np.column_stack([-u[:, :2], u[:, 2]])
    projected, _ = cv2.projectPoints(v_cv, np.zeros(3), np.zeros(3), lens.camera_matrix, lens.distortion)
    apart = largest(projected[:, 0], measured_px)
    shown("5", "OpenCV's projection of the same directions", apart, 1e-9, " px")
    origin = camera.pixels_from_directions([[0.0, 0.0, 1.0]])
    shown("6", "the principal point", largest(origin[0], s.principal_px), 1e-12, " px")


def vectors_and_deviation(rng: np.random.Generator, shown: Shown) -> None:
    exact = draw_frames(1, N_S, N_C, 0.06, 0.3, CAMERAS, rng, noise=False)
    U, V, _, W_c, V_c, _ = exact.frame(0)
    C, C0 = CAMERAS.R_cs.as_matrix(), R_CS0.as_matrix()
    R_si = fit_attitudes(U, V, isotropic_covariance(U, 1e-6), np.array([0, len(U)])).R_si[0]
    W, R_ci = U @ C.T, C @ R_si
    shown("7", "w = R_cs u = R_cs R_si v", largest(W, V @ R_ci.T), 1e-12)
    cov = isotropic_covariance(W, 1e-6)
    rotated = C.T @ cov @ C
    apart = largest(rotated, isotropic_covariance(U, 1e-6)) / 1e-12
    shown("10", "covariances rotated to frame s", apart, 1e-12)
    shown("11", "theta of R_cs = M R_cs0", largest(theta_between(CAMERAS.R_cs, R_CS0), THETA), 1e-15, " rad")
    size, K = np.linalg.norm(THETA), bracket(THETA)
    literal = np.eye(3) + np.sin(size) / size * K + (1 - np.cos(size)) / size**2 * K @ K
    shown("12", "M as printed", largest(M, literal), 1e-15)
    shown("12", "M as SciPy's matrix exponential", largest(M, scipy.linalg.expm(K)), 1e-15)
    shown("13", "M - I - [[theta]] over |theta|^2", largest(M, np.eye(3) + K) / size**2, 0.5)
    shown("14", "u through M", largest(U, W @ M @ C0), 1e-15)
    move = rng.normal(0.0, 2.0, (N_C, 3))
    X = 530e3 * V_c
    moved = (X + move) / np.linalg.norm(X + move, axis=1, keepdims=True)
    linear = (move - np.sum(move * V_c, axis=1)[:, None] * V_c) / 530e3
    shown("15", "W = R_ci V - R_ci dV", largest(W_c, moved @ R_ci.T - (moved - V_c) @ R_ci.T), 1e-11)
    shown("15", "dV of 2 m by first order", largest(moved - V_c, linear), 1e-10)
    print(f"       neglected by the paper: {2.0 / 530e3 / ARCSEC:.2f} arcsec for 2 m of position")
    shown("16", "u = R_cs0^T M^T R_ci V", largest(U, V @ (C0.T @ M.T @ R_ci).T), 1e-12)
    T = Rotation.random(rng=rng).as_matrix()
    apart = largest(V @ ((T @ C).T @ T @ R_ci).T, V @ (C.T @ R_ci).T)
    shown("17", "u after R_cs -> T R_cs, R_ci -> T R_ci", apart, 1e-14)
    blind = solve_total(np.zeros((3, 3)), np.zeros(3), sigma_observable_rad=1e-3)
    shown("17", "directions that stars alone determine", 3.0 - len(blind.unobservable), 0.0)
    W0 = R_CS0.apply(U)
    shown("18", "W0 = R_cs0 U = M^T W", largest(W0, W @ M), 1e-15)
    first = W + np.einsum("nab,b->na", np.array([bracket(w) for w in W]), THETA)
    shown("19", "W0 - W - [[W]] theta over |theta|^2", largest(W0, first) / size**2, 0.5)
    matrix_28 = np.array([[1, 0.001, -0.002], [-0.001, 1, 0.003], [0.002, -0.003, 1]])
    printed = np.array([matrix_28[1, 2], matrix_28[2, 0], matrix_28[0, 1]])
    apart = largest(printed, paper_scenario().installation.theta_rad)
    shown("28", "theta of the printed matrix and of the scenario", apart, 0.0)
    shown("28", "the printed matrix and exp[[theta]]", largest(M, matrix_28), 7.0e-6)
    print(f"       the text's first angle is -0.003, the matrix has {printed[0]:+.3f} rad")


def cross_angles(rng: np.random.Generator, shown: Shown) -> None:
    exact = draw_frames(1, N_S, N_C, 0.06, 0.3, CAMERAS, rng, noise=False)
    U, V, _, W_c, V_c, _ = exact.frame(0)

    def z(theta: np.ndarray) -> np.ndarray:
        W0 = (deviation_from_theta(theta).inv() * CAMERAS.R_cs).apply(U)
        return np.asarray(W0 @ W_c.T - V @ V_c.T)

    step = 1e-6 * np.eye(3)
    derivative = np.stack([(z(d) - z(-d)) / 2e-6 for d in step], axis=-1)
    cross = np.cross(CAMERAS.R_cs.apply(U)[:, None, :], W_c[None, :, :])
    size = np.abs(cross).max()
    for number in ("20", "A5"):
        apart = largest(derivative, cross) / size
        shown(number, "coefficient of theta with the sign +, numerically", apart, 1e-8)
        wrong = largest(derivative, -cross) / size
        print(f"       with the printed sign -: {wrong:.1f} times the coefficient")
    noisy = noisy_frames(exact, rng).frame(0)
    U, V, _, W_c, V_c, _ = noisy
    W0 = R_CS0.apply(U)
    Z = (W0 @ W_c.T - V @ V_c.T).ravel()
    H = np.cross(W0[:, None, :], W_c[None, :, :]).reshape(-1, 3)
    left = np.abs(Z - H @ THETA).max() / np.abs(Z).max()
    shown("21", "z - (W0 x W) theta over the largest z", left, 1e-2)
    shown("23", "elements of Z less n_s n_c", abs(len(Z) - N_S * N_C), 0)
    normal_equations(noisy, Z, H, W0, shown)


def normal_equations(frame: tuple, Z: np.ndarray, H: np.ndarray, W0: np.ndarray, shown: Shown) -> None:
    _, _, s_s, W_c, _, s_c = frame
    P = np.zeros((N_S, N_C, N_S, N_C))  # (A6) with the terms of (A15), element by element
    R_s, R_c = isotropic_covariance(W0, s_s), isotropic_covariance(W_c, s_c)
    for i in range(N_S):
        P[i, :, i, :] += W_c @ R_s[i] @ W_c.T
    for j in range(N_C):
        P[:, j, :, j] += W0 @ R_c[j] @ W0.T
    E = np.einsum("jab,ia,ub->jiu", R_c, W0, W0)
    cross = np.cross(W0[:, None, :], W_c[None, :, :])
    terms = np.einsum("j,ija,uja->jiu", s_c**2, cross, cross)
    shown("A15", "E(i|j|u) of (A6) as printed", largest(E, terms) / np.abs(E).max(), 1e-12)
    P = P.reshape(N_S * N_C, -1)
    G_s = s_s[:, None, None] * np.array([bracket(w) for w in W0])
    G_c = s_c[:, None, None] * np.array([bracket(w) for w in W_c])
    shown("A7", "R = G G^T", largest(G_c @ np.swapaxes(G_c, 1, 2), R_c) / R_c.max(), 1e-12)
    B = np.zeros((N_S, N_C, N_S + N_C, 3))
    for i in range(N_S):
        for j in range(N_C):
            B[i, j, i], B[i, j, N_S + j] = W_c[j] @ G_s[i], W0[i] @ G_c[j]
    signed = np.concatenate([s_s[:, None, None] * cross, -s_c[:, None] * cross])
    of_targets = np.stack([B[:, j, N_S + j] for j in range(N_C)], axis=1)
    blocks = np.concatenate([B[range(N_S), :, range(N_S)], of_targets])
    shown("A9", "blocks of B and +-sigma (W0 x W)", largest(blocks, signed) / np.abs(signed).max(), 1e-12)
    B = B.reshape(N_S * N_C, -1)
    shown("A6", "covariance of z, element by element, and B B^T", largest(P, B @ B.T) / P.max(), 1e-12)
    apart = largest(B.shape, (N_S * N_C, 3 * (N_S + N_C)))
    shown("A10", "rows and columns of B less n_s n_c, 3 (n_s + n_c)", apart, 0)
    U, S, _ = np.linalg.svd(B)
    D = np.zeros(len(B))
    D[: len(S)] = S**2
    shown("A11", "U D U^T and P_Z", largest(U * D @ U.T, P) / P.max(), 1e-12)
    rank = int(np.count_nonzero(S > 1e-9 * S[0]))
    shown("24", "rank of P_Z less 2 n_s + 2 n_c - 3", abs(rank - (2 * N_S + 2 * N_C - 3)), 0)
    print(f"       P_Z has {len(P)} rows and rank {rank}: (24) and (25) as printed need its inverse")
    inverse = np.linalg.pinv(P, rcond=1e-18 / 1e-10, hermitian=True)
    F, F_theta = H.T @ inverse @ H, H.T @ inverse @ Z
    literal, literal_theta = frame_information_literally(*frame, R_CS0)
    shown("25", "H^T P^+ H and the ten steps", largest(F, literal) / literal.max(), 1e-7)
    theta = np.linalg.solve(literal, literal_theta)
    shown("25", "theta by both", largest(np.linalg.solve(F, F_theta), theta), 1e-9, " rad")
    zeta, C = (U.T @ Z)[:rank], (U.T @ H)[:rank]

    def residual(t: np.ndarray) -> float:
        return float(0.5 * np.sum((zeta - C @ t) ** 2 / D[:rank]))  # (A12) but for constants

    steps = 1e-7 * np.eye(3)
    slope = max(abs(residual(theta + d) - residual(theta - d)) / residual(theta) for d in steps)
    shown("A12", "relative slope of the likelihood at theta", slope, 1e-6)


def in_ten_steps(frames: list[tuple[np.ndarray, ...]], R_cs: Rotation) -> tuple[Rotation, np.ndarray, int]:
    """All ten steps over frames, until M is the identity to 1e-12 rad: R_cs, its covariance, iterations."""
    for iteration in range(1, 11):
        pairs = [frame_information_literally(*frame, R_cs) for frame in frames]
        F, right = (np.sum(part, axis=0) for part in zip(*pairs))
        theta = np.linalg.solve(F, right)
        R_cs = deviation_from_theta(theta) * R_cs  # step 10, (11)
        if np.linalg.norm(theta) < 1e-12:
            return R_cs, np.linalg.inv(F), iteration
    raise AssertionError(f"M is still {np.linalg.norm(theta):.2g} rad from the identity")


def forms_and_line(rng: np.random.Generator, shown: Shown) -> None:
    frames = draw_frames(6, 60, 20, 0.06, 0.3, CAMERAS, rng)
    each = [frames.frame(k) for k in range(len(frames))]
    R_cs, covariance, iterations = in_ten_steps(each, R_CS0)
    F, _ = frame_pairs(prepare_frames(frames), R_cs)
    literal = np.array([frame_information_literally(*frame, R_cs)[0] for frame in each])
    shown("A13", "information form and truncated SVD", largest(F, literal) / np.abs(literal).max(), 1e-9)
    error = theta_between(R_cs, CAMERAS.R_cs) / np.sqrt(np.diag(covariance))
    shown("A13", f"error of theta over its 1 sigma after {iterations} iterations", np.abs(error).max(), 4.0)
    steps = calibrate_frames(draw_frames(400, 30, 10, 0.06, 0.3, CAMERAS, rng), R_CS0).theta_steps
    second, third = (step / ARCSEC for step in steps[1:3])
    found = ", ".join(f"{value:+.2f}" for value in second)
    print(f"       section 2.3: one iteration from (28) leaves {found} arcsec in X, Y, Z")
    shown("2.3", "the third iteration's step", np.abs(third).max(), 1e-4, " arcsec")
    camera = calibrated_line_camera(paper_scenario().line_camera)
    ideal = virtual_camera(camera).ccds[0]
    points = np.vstack([ccd.focal_plane(np.arange(ccd.n_px)) for ccd in camera.ccds])
    A, L = np.column_stack([points[:, 1], np.ones(len(points))]), points[:, 0]
    a, b = np.linalg.inv(A.T @ A) @ A.T @ L  # (27)
    x, y = ideal.focal_plane([0.0, ideal.n_px - 1.0]).T
    shown("26", "residuals A x - L across A", np.abs(A.T @ (A @ [a, b] - L)).max() / np.abs(L).sum(), 1e-12)
    shown("27", "virtual CCD and the line y = a x + b", largest(a * y + b, x) / 1e-5, 1e-6, " px")


def noise(rng: np.random.Generator, shown: Shown) -> None:
    exact = draw_frames(1, N_S, N_C, 0.06, 0.3, CAMERAS, rng, noise=False)
    U, _, s_s, W_c, _, s_c = exact.frame(0)
    draws = [noisy_frames(exact, rng) for _ in range(DRAWS)]
    chance = 5.0 / np.sqrt(DRAWS)  # five sigma of an element of a covariance, relative
    for numbers, true, sigma, seen in (
        (("8", "A14"), U, s_s, np.array([d.u_s for d in draws])),
        (("9", "A4"), W_c, s_c, np.array([d.w_c for d in draws])),
    ):
        off = (seen - true) / sigma[:, None]
        expected = isotropic_covariance(true, 1.0)
        sample = np.einsum("kna,knb->nab", off, off) / DRAWS
        for number in numbers:
            apart = largest(sample, expected)
            shown(number, "sample covariance and sigma^2 (I - u u^T), of sigma^2", apart, 2 * chance)
    off_s, off_c = (
        (np.array([d.u_s for d in draws]) - U) / s_s[:, None],
        (np.array([d.w_c for d in draws]) - W_c) / s_c[:, None],
    )
    both = np.einsum("ka,kb->ab", off_s[:, 0], off_s[:, 1]) / DRAWS
    shown("A1", "correlation of two stars", np.abs(both).max(), chance)
    delta = off_s * s_s[:, None]
    along, size = np.einsum("kna,na->kn", delta, U), np.sum(delta**2, axis=2)
    shown("A2", "noise along u over the largest |noise|^2", largest(along, 0.0) / size.max(), 0.51)
    cov = isotropic_covariance(U, s_s)
    shown("A3", "R u over sigma^2", largest(np.einsum("nab,nb->na", cov, U), 0.0) / s_s[0] ** 2, 1e-12)
    information = information_of_directions(U, cov)
    apart = largest(information, np.linalg.pinv(cov, rcond=1e-6, hermitian=True)) * s_s[0] ** 2
    shown("A3", "pseudo-inverse of R", apart, 1e-9)
    eps = rng.standard_normal((DRAWS, 3))
    G = bracket(W_c[0])
    sample = (eps @ G.T).T @ (eps @ G.T) / DRAWS
    apart = largest(sample, isotropic_covariance(W_c[:1], 1.0)[0])
    shown("A8", "covariance of G epsilon, of sigma^2", apart, 2 * chance)
    w_i, w_j, n_s, n_c = CAMERAS.R_cs.apply(U[0]), W_c[0], off_s[:, 0] * s_s[0], off_c[:, 0] * s_c[0]
    dz = n_c @ w_i + CAMERAS.R_cs.apply(n_s) @ w_j
    predicted = np.sum(np.cross(w_i, w_j) ** 2) * (s_s[0] ** 2 + s_c[0] ** 2)
    shown("22", "variance of dz over (A6), less 1", abs(dz.var() / predicted - 1.0), 1.5 * chance)


GROUPS = (cameras_and_directions, vectors_and_deviation, cross_angles, forms_and_line, noise)  # seeds 1, 2, …
