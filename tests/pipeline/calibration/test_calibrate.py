"""From pixels to the matrix on `fixtures/mini`: what the result must be, what must not matter to it, and the
exit status where the data contradict themselves.
"""

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest
from command_line import ran
from edits import replaced, rows_of, write_rows
from fixture_strips import FIXTURE, stopped_run

from boresight.geometry import attitude_estimate
from boresight.geometry.attitude_estimate import fit_attitudes
from boresight.geometry.constants import WGS84
from boresight.geometry.geodesy import geodetic_from_ecef, unit_vectors
from boresight.geometry.groundlight import LightEffects, apparent_ground_directions
from boresight.geometry.installation import theta_between
from boresight.pipeline.calibration.calibrate import calibrate_dump
from boresight.pipeline.errors import DataNotSufficientError
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.results.folder import store_of
from boresight.pipeline.results.reading import read_saved_result
from boresight.pipeline.results.validate import validation_of
from boresight.pipeline.results.writing import write_result
from boresight.pipeline.run.executor import InOrder
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages import exposure as stage


@pytest.fixture
def whole(demo: Path) -> Path:
    """The result of the whole fixture; `truth/` was not there while it was made. Read only."""
    return demo / "demo-result"


@pytest.fixture
def small(finished: tuple[Path, Path]) -> tuple[Path, bytes]:
    """One strip of the fixture, calibrated: the dump and the bytes of installation.json."""
    dump, result = finished
    return dump, (result / "installation.json").read_bytes()


def test_fixture_is_calibrated_within_its_own_covariance_and_check_points_within_their_errors(whole):
    # Normalised error squared of three angles: chi-square of 3, below 16.27 in 999 of 1000 runs; each axis
    # within 4 of its own sigmas. The pre-launch matrix was wrong by 770 arcsec.
    outcome = validation_of(read_saved_result(whole), open_dump(FIXTURE))
    assert outcome.nees < 16.27
    assert np.all(np.abs(outcome.error_rad) < 4.0 * outcome.sigma_rad)
    assert np.linalg.norm(outcome.before_rad) > 100 * np.linalg.norm(outcome.error_rad)
    # 2 m of position, 0.75 m of clock (1 sigma), three strips: 8 m is three sigma; before it was a kilometre.
    assert max(outcome.after.rms_m) < 8.0
    assert min(outcome.before.rms_m) > 500.0
    listed = rows_of(FIXTURE / "truth" / "check_points.csv")
    assert len(outcome.after.along_m) + outcome.without == len(listed)


def test_attitudes_are_fitted_once_and_the_saved_ones_are_those_of_the_estimate(
    finished: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(finished[1], tmp_path / "result")
    fits = []
    counted = lambda *given: fits.append(fit_attitudes(*given)) or fits[-1]  # noqa: E731
    monkeypatch.setattr(attitude_estimate, "fit_attitudes", counted)
    found = calibrate_dump(open_dump(finished[0]), Settings(), store_of(tmp_path / "result"), InOrder())
    assert len(fits) == 1
    saved = pq.read_table(finished[1] / "sightings/exposures.parquet").to_pydict()
    row = {name: k for k, name in enumerate(saved["exposure_id"])}
    strip = found.strips[0]
    used = strip.attitudes
    assert used is not None
    for exposure, R_si, covariance in zip(strip.exposures, used.R_si, used.covariance_s):
        assert saved["R_si"][row[exposure.exposure_id]] == R_si.ravel().tolist()
        assert saved["covariance_s"][row[exposure.exposure_id]] == covariance.ravel().tolist()


def test_targets_are_seen_through_the_air_and_from_an_orbit_over_rotating_ground(finished, calibration):
    dump = open_dump(finished[0])
    ground, orbit, earth = calibration.strips[0].ground, dump.orbit, dump.orbit.earth
    p_e = {target.target_id: target.p_e for target in dump.targets}
    targets_e = np.array([p_e[name] for name in ground.target_id.tolist()])
    # Zenith path delay of dry air 2.3 m (Saastamoinen): the apparent point is 2.3 m tan z sec^2 z farther.
    airless = LightEffects(refraction=False)
    without, _ = apparent_ground_directions(targets_e, ground.t_s, orbit, earth, airless)
    lat, lon, height = geodetic_from_ecef(targets_e, WGS84)
    R_ie = earth.matrices_ie(ground.t_s)
    up = np.einsum("nij,nj->ni", R_ie, unit_vectors(lon, lat))
    cos_z = -np.einsum("ni,ni->n", up, without)[:, None]
    away = without + cos_z * up  # horizontal, of length sin z
    shift_m = 2.3 * np.exp(-height / 8400.0)[:, None] * away / cos_z**3
    across = shift_m - np.einsum("ni,ni->n", shift_m, without)[:, None] * without
    size = np.linalg.norm(across, axis=1, keepdims=True) / ground.range_m[:, None]
    assert size.max() > 5e-8  # rad: 1.3 deg from the zenith
    error = np.abs((ground.u_i - without) - across / ground.range_m[:, None])
    assert np.all(error < 0.05 * size)  # scale height of the air, and its density that day
    # Rate of change of the satellite's ITRS coordinates over 1 s; the Earth's rotation makes 400 m/s of it.
    v_e = orbit.positions_e(ground.t_s + 0.5) - orbit.positions_e(ground.t_s - 0.5)
    v_i = np.einsum("nij,nj->ni", R_ie, v_e)
    np.testing.assert_allclose(ground.v_rel_i, v_i, rtol=0, atol=1.0)


def test_installation_json_has_exactly_the_fields_of_the_format(whole: Path) -> None:
    content = json.loads((whole / "installation.json").read_text())
    matrix = "R_cs quaternion theta_rad euler_zxy_deg covariance_rad2 ground_m_per_rad"
    fields = f"verdict blind_spots {matrix} frames stars targets rows chi2 dof settings version"
    assert tuple(content) == (*fields.split(), "earth_orientation")
    R = np.array(content["R_cs"])
    # Double precision: an orthonormal matrix, the same rotation in all notations.
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-14)
    saved = read_saved_result(whole)
    assert np.allclose(saved.R_cs.as_matrix(), R, atol=1e-14)
    assert np.allclose(theta_between(saved.R_cs, open_dump(FIXTURE).R_cs0), content["theta_rad"], atol=1e-12)


def test_tables_hold_what_the_summary_counts(whole: Path) -> None:
    content = json.loads((whole / "installation.json").read_text())
    stars = pq.ParquetFile(whole / "sightings/stars.parquet")
    targets = pq.read_table(whole / "sightings/targets.parquet")
    exposures = pq.read_table(whole / "sightings/exposures.parquet")
    assert stars.num_row_groups == len(exposures)
    assert sum(targets.column("kept").to_pylist()) == content["targets"]
    kept = stars.read().column("kept").to_pylist()
    assert sum(kept) == content["stars"]
    told = pq.read_table(whole / "sightings/ledger.parquet").column("kind").to_pylist()
    assert told.count("star") == len(kept) - sum(kept) > 0  # stars of usable exposures that were rejected


def test_run_started_again_makes_nothing_twice_and_gives_the_same_whatever_truth_or_place(small, tmp_path):
    """Of a copy of the dump beside a truth that cannot be read."""
    dump, expected = small
    moved = Path(shutil.copytree(dump, tmp_path / "moved"))
    (moved / "truth").mkdir()
    (moved / "truth" / "installation.toml").write_text("this is not even TOML [[[")
    opened, store = open_dump(moved), store_of(tmp_path)
    first = calibrate_dump(opened, Settings(), store, InOrder())
    again = calibrate_dump(opened, Settings(), store, InOrder())
    assert (first.n_reused, again.n_computed) == (0, 0)
    units = sorted((tmp_path / "work").rglob("*.parquet"))
    units[0].write_bytes(units[0].read_bytes()[:100])  # a damaged unit is made anew
    units[1].unlink()
    third = calibrate_dump(opened, Settings(), store, InOrder())
    assert third.n_computed == 2
    write_result(tmp_path, third, Settings())
    assert (tmp_path / "installation.json").read_bytes() == expected


def test_bad_exposure_is_left_out_with_its_reason_and_only_it_is_made_again(one_strip, finished, tmp_path):
    shutil.copytree(finished[1] / "work", tmp_path / "work")  # of the same strip
    names = sorted(path.name for path in (one_strip / "exposures").iterdir())[3:12:3]
    for name in names:
        (one_strip / "exposures" / name).unlink()
    (one_strip / "exposures" / names[0]).write_bytes((FIXTURE / "exposures" / names[0]).read_bytes()[:20_000])
    black = np.random.default_rng(5).normal(12, 2, (768, 1024)).clip(0, 255).astype(np.uint8)
    cv2.imwrite(str(one_strip / "exposures" / names[1]), black)
    cv2.imwrite(str(one_strip / "exposures" / names[2]), black[:100])
    after = calibrate_dump(open_dump(one_strip), Settings(), store_of(tmp_path), InOrder())
    left_out = {o.subject.name: o.text for o in after.omissions if o.subject.kind == "exposure"}
    ids = [name.removesuffix(".png") for name in names]
    assert "byte 20000: found end of file, expected the rest of the PNG chunk" in left_out[ids[0]]
    assert "stars" in left_out[ids[1]] and "needed" in left_out[ids[1]]
    assert "image size: found 1024 x 100 px, expected 1024 x 768 px" in left_out[ids[2]]
    assert len(after.stars) == 14 - 3
    assert after.n_computed <= 3 + 2  # the three exposures, and both matchings of the strip they belong to


def test_fault_in_one_exposure_is_that_exposures_own(one_strip, finished, tmp_path, monkeypatch):
    sound = stage.sight_stars

    def fragile(exposure_id: str, *arguments: object, **more: object) -> object:
        if exposure_id.endswith("5"):
            raise ValueError("an unforeseen matrix")
        return sound(exposure_id, *arguments, **more)

    monkeypatch.setattr(stage, "sight_stars", fragile)
    shutil.copytree(finished[1] / "work", tmp_path / "work")
    for unit in (tmp_path / "work" / "exposures").glob("*5.*"):
        unit.unlink()
    found = calibrate_dump(open_dump(one_strip), Settings(), store_of(tmp_path), InOrder())
    (left_out,) = [o for o in found.omissions if o.subject.kind == "exposure"]
    assert left_out.subject.exposure.endswith("5")
    says = "internal error in sight_exposure: ValueError: an unforeseen matrix; please report"
    assert says in left_out.text


def test_commands_exit_as_promised(one_strip: Path, tmp_path: Path) -> None:
    ran("calibrate", one_strip, status=2)  # --out is missing
    ran("simulate", "no-such-scenario", tmp_path / "x", status=2)
    ran("simulate", "mini", tmp_path / "x", "--set", "strips.cuont=3", status=2)
    ran("--version")


def test_a_wrong_focal_length_of_the_star_camera_refutes_the_result(one_strip: Path, tmp_path: Path) -> None:
    replaced(one_strip / "star_camera.toml", "focal_length_mm = 100.0", "focal_length_mm = 99.8")
    command = ("calibrate", one_strip, "--out", tmp_path / "out", "--workers", 1, "--no-report")
    told = ran(*command, status=3).stdout
    assert told.splitlines()[0].startswith("verdict                   refuted by "), told
    content = json.loads((tmp_path / "out/installation.json").read_text())
    (check,) = [c for c in content["verdict"]["checks"] if c["kind"] == "residuals of stars"]
    assert content["verdict"]["outcome"] == "refuted" and not check["holds"]
    assert "refuted by" in ran(*command, status=3).output  # nothing to do, and the verdict stands
    ran(*command, "--accept", "refuted")


def test_targets_listed_under_several_ids_are_counted_once(one_strip, finished, tmp_path):
    rows = rows_of(one_strip / "targets.csv")
    thrice = [row | {"id": row["id"] + more} for more in ("", "-1", "-2") for row in rows]
    write_rows(one_strip / "targets.csv", thrice)
    stopped_run(tmp_path / "out", [one_strip], finished[1])  # exposures need not be made again
    told = ran("calibrate", one_strip, "--out", tmp_path / "out", "--workers", 1, "--no-report").output
    assert "24 targets: 24 given twice" in told, told
    results = (tmp_path / "out", finished[1])
    content, once = (json.loads((folder / "installation.json").read_text()) for folder in results)
    assert content["targets"] == once["targets"] == 12
    # The same sightings: what is given twice makes no matrix more certain, nor another one.
    assert np.array_equal(content["covariance_rad2"], once["covariance_rad2"])
    assert np.array_equal(content["R_cs"], once["R_cs"])


def test_strip_without_targets_is_named_and_the_lack_is_told(one_strip: Path, tmp_path: Path) -> None:
    lines = (one_strip / "targets.csv").read_text().splitlines()
    far = lines[1].split(",")
    far[1], far[2] = "-60.0", "10.0"
    (one_strip / "targets.csv").write_text("\n".join([lines[0], ",".join(far)]) + "\n")
    with pytest.raises(
        DataNotSufficientError, match=r"14 exposures identified, 0 targets matched in 1 strips"
    ):
        calibrate_dump(open_dump(one_strip), Settings(), store_of(tmp_path), InOrder())
