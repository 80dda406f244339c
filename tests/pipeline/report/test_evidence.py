"""What is saved for the report: it agrees with the estimate, and its predictions with its residuals."""

import json
import pickle
from dataclasses import replace
from types import SimpleNamespace as Of

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from pytest import approx
from scipy.spatial.transform import Rotation

from boresight.calib.settings import CalibrationSettings
from boresight.geometry.sightings import StarSightings, isotropic_covariance
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.report import evidence
from boresight.pipeline.report.evidence import write_evidence
from boresight.pipeline.report.star_preview import star_preview
from boresight.pipeline.results.angles import MeasuredStrip, cross_angles
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.match_pictures import match_pictures
from boresight.simulator.campaign import CameraPair, StripPlan, draw_strips, installation_by_tilt
from boresight.star_id.settings import StarSettings

ERRORS = ("sigma_position_m", "sigma_clock_s", "sigma_vibration_rad", "sigma_distortion_rad")
NONE = dict.fromkeys(ERRORS, 0.0)


def table(finished, name):
    return pq.read_table(finished[1] / "evidence" / f"{name}.parquet")


def test_convergence_ends_at_the_result(finished):
    installation = json.loads((finished[1] / "installation.json").read_text())
    steps = table(finished, "convergence").to_pylist()
    sigma = np.sqrt(np.diag(installation["covariance_rad2"]))
    assert steps[-1]["sigma_rad"] == approx(sigma, rel=1e-6)
    assert np.abs(steps[-1]["theta_rad"]).max() < 0.02 * sigma.max()  # about the last iteration's matrix
    assert (steps[-1]["frames"], steps[-1]["targets"]) == (installation["frames"], installation["targets"])


def test_twice_as_many_strips_have_at_least_the_error_of_twice_as_many_observations(finished):
    installation = json.loads((finished[1] / "installation.json").read_text())
    context = json.loads((finished[1] / "evidence" / "context.json").read_text())
    told = {one["change"]: np.array(one["sigma_rad"]) for one in context["improvements"]}
    share = told["twice as many strips"] / np.sqrt(np.diag(installation["covariance_rad2"]))
    # sqrt(1/2) if all errors were those of strips; what strips have in common does not average
    assert np.sqrt(0.5) - 1e-6 < share.min() and share.max() < 0.99


def test_convergence_knows_nothing_while_one_axis_is_not_observable(monkeypatch):
    F = np.array([np.diag([1.0, 4.0, 0.0]), np.diag([3.0, 12.0, 25.0])]) * 1e10
    pairs = Of(names=np.array(["a", "b"]), F=F, F_theta=np.einsum("kij,j->ki", F, [3e-6, -2e-6, 1e-6]))
    strips = [
        Of(strip_id=name, exposures=[0] * n, ground=Of(target_id="xyz")) for n, name in enumerate("ab", 4)
    ]
    of = {"estimate": Of(pairs=pairs, prior_shared=np.zeros((0, 0))), "settings": CalibrationSettings()}
    monkeypatch.setattr(evidence, "passes_of", lambda strips, _: strips)
    first, last = evidence._convergence(Of(strips=strips, **of)).to_pylist()
    assert np.isnan(first["theta_rad"]).all() and np.isinf(first["sigma_rad"]).all()
    assert last["theta_rad"] == approx([3e-6, -2e-6, 1e-6])
    assert last["sigma_rad"] == approx([5e-6, 2.5e-6, 2e-6])
    assert [(one["frames"], one["targets"]) for one in (first, last)] == [(4, 3), (9, 6)]


class OtherMachines:
    """An executor to which every item is sent; what it was asked for."""

    def __init__(self):
        self.sent = []

    def map(self, function, items, done):
        self.sent += [pickle.dumps(item) for item in items]
        return InOrder().map(function, items, done)

    def share(self, count):
        return InOrder()


def test_quicklooks_alone_are_made_on_other_machines(finished, calibration, tmp_path):
    dump, others = open_dump(finished[0]), OtherMachines()
    write_evidence(tmp_path, dump, calibration, Settings(), others)
    assert len(others.sent) == sum(len(strip.images.ccds) for strip in dump.strips)
    for path in sorted((tmp_path / "evidence").iterdir()):
        assert path.read_bytes() == (finished[1] / "evidence" / path.name).read_bytes(), path.name


def test_pictures_of_a_match_show_the_same_place(finished):
    for row in table(finished, "matches").to_pylist():
        template, found, surface = (
            cv2.imdecode(np.frombuffer(row[name], np.uint8), cv2.IMREAD_UNCHANGED)
            for name in ("template_png", "found_png", "surface_png")
        )
        assert template.shape == found.shape and surface.ndim == 2
        inner = (slice(8, -8), slice(8, -8))
        assert np.corrcoef(template[inner].ravel(), found[inner].ravel())[0, 1] > 0.8
        assert -1.0 <= row["surface_low"] < row["surface_high"] <= 1.001
        peak = np.unravel_index(surface.argmax(), surface.shape)[::-1]  # whole px
        at = [row["surface_x"] + row["off_x_px"], row["surface_y"] + row["off_y_px"]]
        assert np.abs(np.subtract(peak, at)).max() < 1.0  # half a pixel of the peak, and the fit's own change
        middle = 0.5 * (np.array(template.shape[::-1]) - 1.0)
        assert np.abs(middle - (row["place_x"], row["place_y"])).max() < 1.0  # of chips inside their strip


def test_places_are_those_of_pictures_cut_about_their_middle():
    rng = np.random.default_rng(3)
    chip, surface = rng.normal(size=(230, 201)), rng.normal(size=(121, 131))
    chip[70, 130], surface[40, 30] = 50.0, 50.0  # brightest
    places = {"in_chip": [130.0, 70.0], "in_surface": [28.0, 43.0], "off_px": [2.0, -3.0]}
    made = match_pictures(chip, chip, chip, surface, **{name: np.array(at) for name, at in places.items()})
    shown, peaks = (
        cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED).astype(float)
        for png in (made.difference_png, made.surface_png)
    )
    assert shown.shape == (160, 160) and peaks.shape == (96, 96)
    at_peak = made.surface_x + made.off_x_px, made.surface_y + made.off_y_px
    for picture, (x, y) in ((shown, (made.place_x, made.place_y)), (peaks, at_peak)):
        assert picture[round(y), round(x)] == picture.max() == 255.0


def test_spread_of_cross_angles_is_the_predicted_one():
    # Vectors drawn with white errors only: z over its prediction has unit variance. The pairs of one target
    # share its error, so 8 x 12 targets count: 1 / sqrt(2 * 96) = 7 %, three times that holds.
    plan = StripPlan(strips=8, wave_rad=(0.0, 0.0))
    settings = CalibrationSettings(**NONE)
    R_cs = installation_by_tilt(np.radians(15.0))
    strips, _ = draw_strips(plan, CameraPair(R_cs), np.random.default_rng(4))
    motions = [motion_of(strip) for strip in strips]
    angles = cross_angles(motions, R_cs, settings)
    assert len(angles.z) > 2000
    assert np.std(angles.z / angles.sigma) == approx(1.0, abs=0.21)
    wrong = cross_angles(motions, Rotation.from_rotvec([0.0, 3e-5, 0.0]) * R_cs, settings)
    assert np.std(wrong.z / wrong.sigma) > 2.0  # and it shows a matrix that is off by 6 arcsec


def test_variance_of_a_cross_angle_is_that_of_everything_it_depends_on():
    # The angles are differentiated by differences: each error moved by its own sigma, the squares added.
    position_m, vibration_rad = 2.0, 4e-7
    sizes = {"sigma_position_m": position_m, "sigma_vibration_rad": vibration_rad}
    settings = CalibrationSettings(**NONE | sizes)
    R_cs = installation_by_tilt(np.radians(15.0))
    plan = StripPlan(strips=1, targets=4, duration_s=1.0, exposures=6, wave_rad=(0.0, 0.0))
    motion = motion_of(draw_strips(plan, CameraPair(R_cs), np.random.default_rng(5))[0][0])
    motion = replace(motion, covariance_s=motion.covariance_s * [[1, 1, 2], [1, 1, 2], [2, 2, 4]])
    at = cross_angles([motion], R_cs, settings)
    strip = motion.strip
    nearest = [min(strip.exposures, key=lambda one: abs(one.t_s - t)) for t in strip.ground.t_s.tolist()]
    pairs = [(id, e.exposure_id, hip) for id, e in zip(strip.ground.target_id, nearest) for hip in e.hip]
    assert list(zip(at.target_id, at.exposure_id, at.hip)) == pairs and set(at.strip_id) == {strip.strip_id}
    variance = np.zeros(len(at.z))
    for moved in (*moved_targets(motion, vibration_rad, position_m), *moved_attitudes(motion)):
        variance += (cross_angles([moved], R_cs, settings).z - at.z) ** 2
    stars = {e.exposure_id: e for e in motion.strip.exposures}
    w_j = dict(zip(motion.strip.ground.target_id.tolist(), motion.strip.ground.u_c))
    for n, (exposure, hip, target) in enumerate(zip(at.exposure_id, at.hip, at.target_id)):
        C = R_cs.as_matrix() @ stars[exposure].cov_s[stars[exposure].hip == hip][0] @ R_cs.as_matrix().T
        variance[n] += w_j[target] @ C @ w_j[target]
    # 1 %: second order of the differences, and the motion by which star vectors are carried
    np.testing.assert_allclose(at.sigma, np.sqrt(variance), rtol=0.01)


def moved_targets(motion, vibration_rad, position_m):
    """The motion with all targets moved by one sigma of vibration, measurement, or position of the camera."""
    strip, ground = motion.strip, motion.strip.ground
    values, vectors = np.linalg.eigh(ground.cov_c)
    for k in range(3):
        step = vectors[:, :, k] * np.sqrt(np.maximum(values[:, k], 0.0))[:, None]
        yield replace(motion, strip=replace(strip, ground=replace(ground, u_c=ground.u_c + step)))
        if k:  # across the direction: the eigenvector of the least value is along it
            shaken = ground.u_c + vibration_rad * vectors[:, :, k]
            yield replace(motion, strip=replace(strip, ground=replace(ground, u_c=shaken)))
        seen = ground.u_i * ground.range_m[:, None] - position_m * np.eye(3)[k]
        seen /= np.linalg.norm(seen, axis=1, keepdims=True)
        yield replace(motion, strip=replace(strip, ground=replace(ground, u_i=seen)))


def moved_attitudes(motion):
    """The motion with the attitude of one exposure rotated by one sigma of one axis."""
    for k, covariance in enumerate(motion.covariance_s):
        for step in np.linalg.cholesky(covariance).T:
            matrices = motion.R_si.as_matrix()
            matrices[k] = Rotation.from_rotvec(step).as_matrix() @ matrices[k]
            yield replace(motion, R_si=Rotation.from_matrix(matrices))


class Still:
    """A nominal motion that an `AttitudeTrack` may ask, interpolated from the strip's own."""

    def __init__(self, strip):
        self.t = np.array([e.t_s for e in strip.exposures])
        self.R = strip.R_oi_exposures
        self.rate = (self.R[-1] * self.R[0].inv()).as_rotvec() / (self.t[-1] - self.t[0])

    def R_oi(self, t_s):
        return Rotation.from_rotvec(np.outer(np.asarray(t_s) - self.t[0], self.rate)) * self.R[0]


def motion_of(strip):
    attitudes, covariances = [], []
    for exposure in strip.exposures:
        weight = 0.5 * np.trace(exposure.cov_s, axis1=1, axis2=2)
        attitudes.append(Rotation.align_vectors(exposure.u_s, exposure.u_i, weights=1.0 / weight)[0])
        u = exposure.u_s
        information = ((np.eye(3) - u[:, :, None] * u[:, None, :]) / weight[:, None, None]).sum(axis=0)
        covariances.append(np.linalg.inv(information))
    kept = {"stars_kept": tuple(np.ones(len(e.hip), dtype=bool) for e in strip.exposures)}
    kept |= {"targets_kept": np.ones(len(strip.ground.target_id), dtype=bool)}
    fitted = {"R_si": Rotation.concatenate(attitudes), "covariance_s": np.array(covariances)}
    return MeasuredStrip(strip=strip, orbit=Still(strip), **fitted, **kept)


def test_detections_of_the_star_image_are_told_apart():
    rng = np.random.default_rng(6)
    places = np.array([[30.2, 40.7], [80.5, 20.1], [120.9, 90.3], [60.0, 100.4]])
    y, x = np.mgrid[:128, :160]
    image = rng.normal(20.0, 2.0, (128, 160))
    for (cx, cy), flux in zip(places, (900.0, 1500.0, 1200.0, 700.0)):
        image += flux / (2 * np.pi) * np.exp(-0.5 * ((x - cx) ** 2 + (y - cy) ** 2))
    raw = np.clip(np.round(image), 0, 255).astype(np.uint16)
    found = star_preview(raw, sighted_at(np.zeros((0, 2))), np.zeros(0, dtype=bool), StarSettings()).xy_px
    named = np.array([found[np.argmin(np.linalg.norm(found - place, axis=1))] for place in places[:2]])
    preview = star_preview(raw, sighted_at(named), np.array([True, False]), StarSettings())
    state = {
        n: preview.state[np.argmin(np.linalg.norm(preview.xy_px - p, axis=1))] for n, p in enumerate(places)
    }
    assert state == {0: "used", 1: "rejected", 2: "unused", 3: "unused"}
    assert sorted(preview.hip[preview.hip > 0].tolist()) == [101, 102]
    picture = cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert picture.shape == (128, 160) and preview.shrunk == 1


def sighted_at(xy_px):
    u = np.tile([0.0, 0.0, 1.0], (len(xy_px), 1))
    directions = {"u_s": u, "u_i": u, "cov_s": isotropic_covariance(u, 1e-6)}
    hip = 101 + np.arange(len(xy_px))
    return StarSightings(exposure_id="E1", t_s=0.0, hip=hip, xy_px=xy_px, **directions)


@pytest.mark.parametrize("side", [3000, 5000])
def test_a_large_star_image_is_shown_by_its_brightest_pixels(side):
    image = np.full((64, side), 10, dtype=np.uint16)
    image[32, side // 2] = 255
    preview = star_preview(image, sighted_at(np.zeros((0, 2))), np.zeros(0, dtype=bool), StarSettings())
    picture = cv2.imdecode(np.frombuffer(preview.jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
    assert max(picture.shape) <= 2048 and preview.shrunk == (2 if side == 3000 else 4)
    assert picture.max() > 150
