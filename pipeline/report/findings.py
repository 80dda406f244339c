"""What a person should look at first: patterns in what a calibration rejected or left unexplained.

Each finding states numbers that were measured and the input that would explain them. They change nothing in
the estimate and its verdict.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa

from boresight.calib.verdict import CheckKind
from boresight.gct_match.records import Reason
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.geometry.geoid import egm96
from boresight.geometry.record import Floats
from boresight.geometry.star_camera import StarCamera
from boresight.pipeline.errors import Omission, RawDataError
from boresight.pipeline.files.dump import Dump, TerrainFile, surface_of
from boresight.pipeline.report.ground_map import OUT_OF_VIEW, UNMATCHED, USED, Scene, StripOnGround
from boresight.pipeline.stages.calibrate import Calibration
from boresight.pipeline.stages.strip import match_targets, pushbroom_of

__all__ = ["findings"]

FEWEST = 3  # observations that make a pattern
SMALLEST_HEIGHT_M = 5.0  # systematic difference of heights that is reported
MOST_STRIPS_AGAIN = 4  # strips without any match that are searched again
SMALL_SHARE = 0.4  # of the swath: targets within less are reported
MOST_EXPOSURES = 40  # whose stars are held against other cameras
EXPLAINED = 0.5  # share of the excess of chi-square that an explanation must remove
FLAT_COUNTS = 2.0  # standard deviation of an image without content


def findings(dump: Dump, calibration: Calibration, scenes: Sequence[Scene], ground: pa.Table) -> list[str]:
    """Sentences, the most specific first; none where nothing stands out."""
    rows = [row for row in ground.to_pylist() if row["state"] != OUT_OF_VIEW]
    strips = [one for scene in scenes for one in scene.strips]
    return [
        *_star_camera(dump, calibration),
        *_displaced_strips(calibration, strips, dump.sigma_installation_rad),
        *_silent_ccds(rows, strips),
        *_clouds(rows, strips),
        *_heights(dump, calibration),
        *_spread(calibration, dump),
    ]


def _heights(dump: Dump, calibration: Calibration) -> Iterator[str]:
    """Targets that lie above or below the terrain model on average."""
    targets = [target for task in calibration.tasks for target in task.targets]
    if not isinstance(dump.terrain, TerrainFile) or len(targets) < FEWEST:
        return
    lat, lon, height = geodetic_from_ecef(np.array([target.p_e for target in targets]), WGS84)
    above = height - surface_of(dump.terrain).height_m(lat, lon)
    above = above[np.isfinite(above)]
    if len(above) < FEWEST:
        return
    middle = float(np.median(above))
    spread = 1.4826 * float(np.median(np.abs(above - middle)))
    if abs(middle) < max(SMALLEST_HEIGHT_M, 3.0 * spread / np.sqrt(len(above))):
        return
    geoid = float(np.median(egm96().undulation_m(lat, lon)))
    text = f"The heights of {len(above)} targets differ from the terrain model by {middle:+.1f} m (median)"
    if abs(abs(middle) - abs(geoid)) < 0.2 * abs(geoid):
        text += (
            f", as much as the geoid lies from the ellipsoid there ({geoid:+.1f} m): one of the two has the "
        )
        text += "wrong kind of height; check height_kind in targets.csv and in [terrain] of dump.toml"
    yield f"{text}."


def _silent_ccds(rows: Sequence[dict], strips: Sequence[StripOnGround]) -> Iterator[str]:
    """CCDs in which no target at all was matched."""
    for ccd in sorted({row["ccd"] for row in rows if row["ccd"] >= 0}):
        here = [row for row in rows if row["ccd"] == ccd]
        if len(here) < FEWEST or any(row["state"] != UNMATCHED for row in here):
            continue
        names = sorted({row["strip_id"] for row in here})
        flat = [one.strip_id for one in strips if one.strip_id in names and _is_flat(one, ccd)]
        where = f"{len(names)} strips: {', '.join(names[:5])}"
        text = f"None of {len(here)} targets in CCD {ccd} was matched ({where})"
        if flat:
            text += f"; its images hold a single grey value in {len(flat)} of them: the detector or its file "
            text += "is dead"
        yield f"{text}. Check the images of CCD {ccd} in strips.csv and its place in remote_camera.toml."


def _is_flat(one: StripOnGround, ccd: int) -> bool:
    images = one.task.strip.images
    if ccd not in images.ccds:
        return False
    lines, samples = images.shape(ccd)
    try:
        middle = images.read(ccd, lines // 2, min(lines, lines // 2 + 64), 0, samples)
    except RawDataError:
        return False
    return float(np.std(middle.astype(float))) < FLAT_COUNTS


def _clouds(rows: Sequence[dict], strips: Sequence[StripOnGround]) -> Iterator[str]:
    """Unmatched targets where the strip is brighter and flatter than at the targets that were matched."""
    for one in strips:
        seen: dict[str, list[tuple[str, float, float]]] = {USED: [], UNMATCHED: []}
        for row in rows:
            if row["strip_id"] == one.strip_id and row["state"] in seen and np.isfinite(row["line_px"]):
                look = _window(one, row)
                if look is not None:
                    seen[row["state"]].append((row["target_id"], *look))
        if len(seen[USED]) < FEWEST or not seen[UNMATCHED]:
            continue
        brightness, contrast = np.median([look[1:] for look in seen[USED]], axis=0)
        cloudy = [name for name, b, c in seen[UNMATCHED] if b > brightness + contrast and c < 0.5 * contrast]
        if cloudy:
            yield (
                f"Strip {one.strip_id} is bright and without contrast at {len(cloudy)} targets that were not "
                f"matched ({', '.join(cloudy[:5])}): cloud or snow."
            )


def _window(one: StripOnGround, row: dict) -> tuple[float, float] | None:
    """Mean and standard deviation of the strip within 16 px of a target."""
    images, ccd = one.task.strip.images, row["ccd"]
    if ccd not in images.ccds:
        return None
    lines, samples = images.shape(ccd)
    x, y = (
        int(np.clip(row[f"{name}_px"], 16, size - 17))
        for name, size in (("sample", samples), ("line", lines))
    )
    try:
        window = images.read(ccd, max(0, y - 16), y + 17, max(0, x - 16), x + 17).astype(float)
    except (RawDataError, ValueError):
        return None
    return float(window.mean()), float(window.std())


def _displaced_strips(
    calibration: Calibration, strips: Sequence[StripOnGround], sigma_rad: Floats
) -> Iterator[str]:
    """Strips whose targets are not where the matrix of the others expects them, but agree on a shift."""
    lost = {
        one.strip_id
        for one in calibration.matched
        if not len(one.target_id)
        and sum(o.cause == Reason.NO_COMMON_ROTATION.replace("_", " ") for o in one.omissions) >= FEWEST
    }
    for one in [strip for strip in strips if strip.strip_id in lost][:MOST_STRIPS_AGAIN]:
        again = match_targets(replace(one.task, sigma_installation_rad=np.asarray(sigma_rad, dtype=float)))
        if isinstance(again, Omission) or len(again.target_id) < FEWEST:
            continue
        sample, line = np.median(again.xy_px - again.predicted_px, axis=0)
        later_ms = line / _lines_per_ms(one, again.target_id.tolist(), again.ccd.tolist())
        motion = np.linalg.norm(one.task.orbit.velocities_e(one.model.instants(np.zeros(1)))[0])
        along_m = 1e-3 * later_ms * motion
        spread_ms = 1e3 * calibration.settings.sigma_position_m / motion
        late = "late" if later_ms > 0 else "early"
        yield (
            f"Strip {one.strip_id} was not used: {len(again.target_id)} of its targets agree on places "
            f"{line:+.1f} lines and {sample:+.1f} samples from where the matrix of the other strips expects "
            f"them. If that is a matter of time, its rows are dated {abs(later_ms):.1f} ms too {late} (the "
            f"stated error of position makes {spread_ms:.1f} ms, 1σ, of that uncertain): check the clock "
            "(utc_first_row in strips.csv, time_of_row), then the orbit "
            f"({abs(along_m):.0f} m along the track)."
        )


def _lines_per_ms(one: StripOnGround, targets: Sequence[str], ccds: Sequence[int]) -> float:
    """By how many lines targets appear later if the rows are dated 1 ms earlier, the attitude's motion and
    all else included.
    """
    strip = one.task.strip
    earlier = pushbroom_of(replace(one.task, strip=replace(strip, t_first_row_s=strip.t_first_row_s - 1e-3)))
    p_e = one.p_e
    points = [(ccd, p_e[target][None]) for target, ccd in zip(targets, ccds)]
    then, now = (
        np.array([model.pixels_from_ground(k, p)[1][0] for k, p in points]) for model in (earlier, one.model)
    )
    return float(np.median(then - now))


def _spread(calibration: Calibration, dump: Dump) -> Iterator[str]:
    """Targets that use a small part of the swath."""
    camera, kept = dump.line_camera, calibration.estimate.targets.kept
    y = [strip.ground.u_c[:, 1] / strip.ground.u_c[:, 2] for strip in calibration.strips]
    ends = [
        camera.directions_from_pixels(k, np.array([0.0, camera.n_px(k) - 1.0])) for k in range(camera.n_ccds)
    ]
    swath = np.concatenate(ends)
    width = float(np.ptp(swath[:, 1] / swath[:, 2]))
    share = float(np.ptp(np.concatenate(y))) / width if width > 0.0 and kept.any() else 1.0
    if share < SMALL_SHARE:
        yield (
            f"All targets lie within {share:.0%} of the width of the swath: they hardly determine the "
            "rotation about the boresight (Z). Add targets near both ends of the swath."
        )


def _star_camera(dump: Dump, calibration: Calibration) -> Iterator[str]:
    """Which change of the star camera explains the residuals of the stars, where these are too large."""
    failed = {check.kind for check in calibration.verdict.refuted_by}
    camera = dump.star_camera
    if camera is None or not failed & {CheckKind.STAR_RESIDUALS, CheckKind.STARS_REJECTED}:
        return
    best = max(_explanations(camera, calibration), key=lambda one: one[0], default=(0.0, ""))
    if best[0] > EXPLAINED:
        yield (
            f"{best[0]:.0%} of the stars' excess of χ² disappear with {best[1]}: check star_camera.toml, or "
            "calibrate the camera (boresight star-camera-calibrate)."
        )


def _explanations(camera: StarCamera, calibration: Calibration) -> Iterator[tuple[float, str]]:
    """Share of the excess of chi-square that a change of one part of the camera removes, and the change."""
    steps: dict[str, list[tuple[StarCamera, float]]] = {
        "principal point": [
            (replace(camera, principal_px=(camera.principal_px[0] + 1.0, camera.principal_px[1])), 1.0),
            (replace(camera, principal_px=(camera.principal_px[0], camera.principal_px[1] + 1.0)), 1.0),
        ],
        "focal length": [(replace(camera, focal_m=camera.focal_m * 1.001), 1e-3)],
        "radial distortion": [(replace(camera, q1=camera.q1 + 1e-6), 1e-6)],
    }
    chosen = np.linspace(0, len(calibration.stars) - 1, min(len(calibration.stars), MOST_EXPOSURES)).astype(
        int
    )
    misfit: list[Floats] = []
    changed: dict[str, list[Floats]] = {name: [] for name in steps}
    attitudes = calibration.attitudes
    for k in np.unique(chosen):
        stars, R_si = calibration.stars[k], attitudes.R_si[k]
        u_s = stars.u_i @ R_si.T
        expected = camera.pixels_from_directions(u_s)
        sigma = np.sqrt(0.5 * np.trace(stars.cov_s, axis1=1, axis2=2)) * camera.focal_m / camera.pixel_m
        good = np.isfinite(expected).all(axis=1) & (np.linalg.norm(stars.xy_px - expected, axis=1) < 20.0)
        if good.sum() < FEWEST:
            continue
        weight = 1.0 / sigma[good, None]

        def weighted(xy: Floats) -> Floats:
            return ((xy - expected)[good] * weight).ravel()  # noqa: B023

        turns = [camera.pixels_from_directions(u_s + 1e-5 * np.cross(axis, u_s)) for axis in np.eye(3)]
        Q = np.linalg.qr(np.column_stack([weighted(xy) for xy in turns]))[0]
        free = [weighted(stars.xy_px)] + [
            weighted(c.pixels_from_directions(u_s)) for s in steps.values() for c, _ in s
        ]
        free = [column - Q @ (Q.T @ column) for column in free]
        misfit.append(free.pop(0))
        for name, cameras in steps.items():
            changed[name].append(np.column_stack([free.pop(0) for _ in cameras]))
    if not misfit:
        return
    y = np.concatenate(misfit)
    excess = float(y @ y) - (len(y) - 3 * len(misfit))
    for name, cameras in steps.items():
        A = np.concatenate(changed[name])
        x = np.linalg.lstsq(A, y, rcond=None)[0]
        gain = float(y @ y - np.sum((y - A @ x) ** 2)) / max(excess, 1e-9)
        size = [value * step for value, (_, step) in zip(x, cameras)]
        words = {
            "principal point": lambda s: f"a principal point moved by ({s[0]:+.1f}, {s[1]:+.1f}) px",
            "focal length": lambda s: f"a focal length {100 * s[0]:+.3f} % longer",
            "radial distortion": lambda s: f"a radial distortion q1 changed by {s[0]:+.2g} 1/mm²",
        }
        yield gain, words[name](size)
