"""Targets as points of a GeoDataFrame, in and out; geopandas is not loaded before it is asked for."""

import dataclasses
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from seen_by_astropy import directions_by_astropy, places_below, states_of
from tasks import arrays_of
from wrong_vectors import R_TRUE, SIGMA_C, SIGMA_S, drawn_vectors, unit_vectors

import boresight as bs
from boresight.pipeline.results.folder import DUMPS

geopandas = pytest.importorskip("geopandas", reason="GEOPANDAS IS NOT INSTALLED: no table was tried")
MINI = bs.example("mini")


@pytest.fixture(scope="module")
def states() -> pd.DataFrame:
    return states_of(MINI)


def points_of(table: pd.DataFrame, crs: object = 4979) -> geopandas.GeoDataFrame:
    places = geopandas.points_from_xy(table["lon_deg"], table["lat_deg"], table["height_m"], crs=4979)
    plain = table.drop(columns=["lat_deg", "lon_deg", "height_m"])
    return geopandas.GeoDataFrame(plain, geometry=places).to_crs(crs)


def calibrated(states: pd.DataFrame, table: pd.DataFrame, given: pd.DataFrame) -> bs.Calibration:
    rng = np.random.default_rng(5)
    field = unit_vectors(np.column_stack([rng.uniform(-0.15, 0.15, (20, 2)), np.ones(20)]))
    w_c = R_TRUE.apply(directions_by_astropy(states, table))  # frames s and i are one
    return bs.calibrate_vectors(field, field, SIGMA_S, w_c, given, SIGMA_C, R_TRUE, orbit=states)


@pytest.mark.parametrize("crs", [4326, 4979, 32647])
def test_points_are_the_places_that_columns_state(states: pd.DataFrame, crs: int) -> None:
    table = places_below(states, 30)
    by_columns, by_points = (calibrated(states, table, one) for one in (table, points_of(table, crs)))
    assert (by_points.R_cs * by_columns.R_cs.inv()).magnitude() < 1e-12
    out = by_points.geodataframe()
    assert out.crs.to_epsg() == 4326 and len(out) == 12 and "residual_x_arcsec" in out
    np.testing.assert_allclose(out.geometry.x, table["lon_deg"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(out.geometry.y, table["lat_deg"], rtol=0, atol=1e-9)


def test_points_without_a_reference_system_or_above_a_geoid_are_refused(states: pd.DataFrame) -> None:
    table = places_below(states, 30)
    unknown = points_of(table).set_crs(None, allow_override=True)
    for points in (unknown, points_of(table).set_crs("EPSG:4326+5773", allow_override=True)):
        with pytest.raises(ValueError, match=r"v_targets of frame 0: found Point in .*expected points in"):
            calibrated(states, table, points)
    circles = points_of(table, 32647).set_geometry(points_of(table, 32647).buffer(1.0))
    with pytest.raises(ValueError, match="found Polygon in"):
        calibrated(states, table, circles)


def test_a_dump_of_arrays_takes_points_and_its_result_gives_them() -> None:
    arrays = arrays_of(MINI)
    targets = arrays["targets"].rename(columns=dict(zip(("lat_deg", "lon_deg"), ("latitude", "longitude"))))
    at = geopandas.points_from_xy(targets["longitude"], targets["latitude"])
    points = geopandas.GeoDataFrame(targets, geometry=at, crs=4326)
    out = bs.calibrate(bs.dump_from_arrays(**arrays | {"targets": points})).geodataframe()
    known = targets.set_index("id").loc[out["target_id"]]
    np.testing.assert_allclose(out.geometry.x, known["longitude"], rtol=0, atol=1e-8)
    np.testing.assert_allclose(out.geometry.y, known["latitude"], rtol=0, atol=1e-8)


def test_a_result_folder_gives_the_points_of_its_evidence(finished: tuple[Path, Path]) -> None:
    out = bs.read_result(finished[1]).geodataframe()
    known = pd.read_csv(finished[0] / "targets.csv").set_index("id").loc[out["target_id"]]
    np.testing.assert_allclose(out.geometry.x, known["lon_deg"], rtol=0, atol=1e-8)


def test_a_result_of_several_dumps_gives_the_points_and_stars_of_each(
    finished: tuple[Path, Path], tmp_path: Path
) -> None:
    alone, names = bs.read_result(finished[1]), ["first", "second"]
    for name in names:
        for part in ("evidence", "sightings"):
            shutil.copytree(finished[1] / part, tmp_path / name / part)
    ground = pd.read_parquet(path := tmp_path / "second/evidence/ground.parquet")
    ground.assign(lon_deg=ground["lon_deg"] + 1.0).to_parquet(path)
    (tmp_path / DUMPS).write_text(json.dumps({"dumps": names}))
    rows = [alone.targets.assign(strip_id=f"{name}/" + alone.targets["strip_id"]) for name in names]
    joint = dataclasses.replace(alone, folder=tmp_path, targets=pd.concat(rows, ignore_index=True))
    lon, lat = alone.geodataframe().geometry.x, alone.geodataframe().geometry.y
    np.testing.assert_array_equal(joint.geodataframe().geometry.x, [*lon, *(lon + 1.0)])
    np.testing.assert_array_equal(joint.geodataframe().geometry.y, [*lat, *lat])
    stars = [alone.residuals("stars").assign(dump=name) for name in names]
    pd.testing.assert_frame_equal(joint.residuals("stars"), pd.concat(stars, ignore_index=True))


def test_directions_have_no_places() -> None:
    result = bs.calibrate_vectors(*drawn_vectors(np.random.default_rng(6)))
    with pytest.raises(ValueError, match="no place of a target is known"):
        result.geodataframe()


def test_nothing_loads_geopandas_before_it_is_needed() -> None:
    code = "import boresight, sys; boresight.calibrate_vectors; print('geopandas' in sys.modules)"
    assert subprocess.check_output([sys.executable, "-c", code], text=True) == "False\n"
