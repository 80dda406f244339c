"""A simulated mission comes back from its dump as it was, and its truth lies in one folder alone."""

import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from edits import rows_of

from boresight.geometry.constants import ARCSEC, WGS84
from boresight.geometry.geodesy import geodetic_from_ecef
from boresight.pipeline.files.dump import Dump, open_dump
from boresight.pipeline.files.dump_schema import Errors
from boresight.pipeline.files.dump_writer import Rendered, write_dump
from boresight.pipeline.files.images.star_images import read_exposure
from boresight.pipeline.files.scenario_file import fly, named_scenario
from boresight.pipeline.run.executor import FORKS, Processes
from boresight.simulator.mission_records import Mission

OF_EACH_CCD = ("look_ccd_shift_px", "look_ccd_slope_px", "look_ccd_bend_px")
SMALL = (
    *("strips.count=1", "strips.lines=300", "strips.exposure_lead_s=0.1", "sky.bits=12"),
    *("star_camera.width_px=128", "star_camera.height_px=96", "star_camera.principal_px=[64.0, 48.0]"),
    *("targets.per_strip=2", "targets.check_points_per_strip=3", "targets.chip_size_px=48"),
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[Mission, Path, Dump]:
    root = tmp_path_factory.mktemp("written") / "dump"
    mission = fly(named_scenario("mini", SMALL), 3)
    targets = tuple(replace(one, sigma_m=(0.4, 0.7, 1.1 + n)) for n, one in enumerate(mission.targets))
    mission = replace(mission, targets=targets)
    write_dump(mission, root, created_by="a test")
    return mission, root, open_dump(root)


@pytest.mark.skipif(not FORKS, reason="NO FORK on this system: missions are rendered by one process")
def test_images_rendered_by_several_processes_are_the_same_bytes(flown, tmp_path):
    mission, root, _ = flown
    told: list[int] = []

    def each(render: Callable[[Rendered], None], images: Sequence[Rendered]) -> list[None]:
        return Processes(3).map(render, images, lambda done, _: told.append(done))

    write_dump(mission, tmp_path / "dump", created_by="a test", each=each)
    files = sorted(path.relative_to(root) for path in root.rglob("*") if path.is_file())
    assert files == sorted(p.relative_to(tmp_path / "dump") for p in tmp_path.rglob("*") if p.is_file())
    assert [f for f in files if (root / f).read_bytes() != (tmp_path / "dump" / f).read_bytes()] == []
    assert told == list(range(1, len(mission.strips) + len(mission.exposures) + 1))


def test_cameras_and_matrix_come_back_to_fourteen_digits(flown: tuple[Mission, Path, Dump]) -> None:
    mission, _, dump = flown
    xy = np.array([[0.0, 0.0], [100.0, 30.0]])
    expected = mission.star_camera.directions_from_pixels(xy)
    assert np.allclose(dump.star_camera.directions_from_pixels(xy), expected, atol=1e-15)
    for ccd in range(mission.line_camera.n_ccds):
        expected = mission.line_camera.directions_from_pixels(ccd, np.array([0.0, 100.0, 500.0]))
        got = dump.line_camera.directions_from_pixels(ccd, np.array([0.0, 100.0, 500.0]))
        assert np.allclose(got, expected, atol=1e-14)  # rad: 1e-10 px
    assert (dump.R_cs0 * mission.installation.R_cs.inv()).magnitude() < 1e-15
    assert dump.errors.vibration_arcsec * ARCSEC == mission.errors.vibration_arcsec * ARCSEC
    drawn = mission.scenario.errors
    assert (dump.errors.look_distortion_px, dump.errors.look_ccd_px) == (drawn.distortion_px, drawn.ccd_px)
    # a dump that does not state its CCDs' own errors means the same: both may be calibrated together
    unstated = Errors(**dump.errors.model_dump(exclude=set(OF_EACH_CCD)))
    assert unstated.look_ccd_px == dump.errors.look_ccd_px


def test_times_and_orbit_come_back_to_the_nanosecond_and_the_micrometre(flown):
    mission, _, dump = flown
    shift = mission.epoch.tai_s - dump.epoch.tai_s
    assert np.allclose([e.t_s - shift for e in dump.exposures], [e.t_s for e in mission.exposures], atol=1e-9)
    assert dump.strips[0].t_first_row_s - shift == pytest.approx(mission.strips[0].t_first_row_s, abs=1e-9)
    assert np.allclose(dump.orbit.t_s - shift, mission.orbit.t_s, atol=1e-9)
    assert np.allclose(dump.orbit.positions_m, mission.orbit.positions_m, atol=1e-6)
    assert np.allclose(dump.orbit.velocities_m_s, mission.orbit.velocities_m_s, atol=1e-9)


def test_pixels_come_back_as_rendered(flown: tuple[Mission, Path, Dump]) -> None:
    mission, _, dump = flown
    exposure = dump.exposures[0]
    read = read_exposure(exposure.path, exposure.file, width=128, height=96, bit_depth=12)
    assert np.array_equal(read, mission.exposures[0].image())
    strip = next(s for s in mission.strips if s.ccd == 2)
    assert np.array_equal(dump.strips[0].images.read(2, 0, 300, 0, 512), np.vstack(list(strip.blocks(128))))
    assert dump.omissions == ()
    for target, of in zip(dump.targets, mission.targets, strict=True):
        assert (target.target_id, *target.sigma_m) == (of.target_id, *of.sigma_m)
        lat_lon = np.degrees(geodetic_from_ecef(target.p_e[None], WGS84)[:2]).ravel()
        assert lat_lon == pytest.approx([of.lat_deg, of.lon_deg], abs=1e-9)


def test_truth_is_in_its_folder_and_nowhere_else(flown: tuple[Mission, Path, Dump]) -> None:
    mission, root, _ = flown
    for name, points in (("check_points", mission.truth.check_points), ("targets", mission.truth.targets)):
        for row, p in zip(rows_of(root / "truth" / f"{name}.csv"), points, strict=True):
            right = {"ccd": p.ccd, "sample": p.sample, "line": p.line, "height_m": p.height_ellipsoidal_m}
            right |= {"lat_deg": p.lat_deg, "lon_deg": p.lon_deg}
            assert {key: float(row[key]) for key in right} == pytest.approx(right, abs=1e-5)
            assert (row["id"], row["strip"]) == (p.point_id, p.strip_id)
    for row, strip in zip(rows_of(root / "truth" / "strips.csv"), mission.truth.strips, strict=True):
        numbers = (strip.clock_offset_s, *strip.position_error_m.tolist())
        assert list(row.values()) == [strip.strip_id, *map(repr, numbers)]
    truth = tomllib.loads((root / "truth" / "installation.toml").read_text())
    assert np.allclose(truth["theta_rad"], mission.truth.theta_rad)
    number = f"{truth['quaternion_cs'][0]:.12f}"
    for path in root.rglob("*"):
        if path.is_file() and path.suffix in (".toml", ".csv", ".oem") and path.parent.name != "truth":
            assert number not in path.read_text(), path


def test_folder_with_something_in_it_is_not_written_over(flown: tuple[Mission, Path, Dump]) -> None:
    mission, root, _ = flown
    with pytest.raises(FileExistsError, match="exists and is not an empty folder"):
        write_dump(mission, root, created_by="a test")
