"""A gyro's record: rates and angles in any unit are the same rotations; what is no gyro is refused."""

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from boresight.geometry.attitude import ConstantRate
from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.dump_schema import GyroFile
from boresight.pipeline.files.gyro_file import read_gyro

EPOCH = Epoch.from_utc("2024-11-20T03:40:00")
STEP_S = 0.1
RATE = np.radians([0.01, -0.06, 0.02])  # rad/s, axes of the gyro
R_SG = Rotation.from_euler("xyz", [30.0, -20.0, 110.0], degrees=True)


def stated(**changed) -> GyroFile:
    values = {
        "file": "gyro.csv",
        "quantity": "rates",
        "unit": "rad",
        "quaternion_sg": R_SG.as_quat().tolist(),
    }
    noise = {"random_walk_arcsec": 0.02, "bias_walk_arcsec_s": 1e-3}
    return GyroFile.model_validate(values | noise | changed)


def record_of(tmp_path, values, *, clock="utc", late=0.0, **changed):
    times = EPOCH.utc_from_seconds(STEP_S * np.arange(len(values)) + late)
    lines = [f"{clock},x,y,z", *(f"{t},{x!r},{y!r},{z!r}" for t, (x, y, z) in zip(times, values.tolist()))]
    (tmp_path / "gyro.csv").write_text("\n".join(lines))
    return read_gyro(tmp_path / "gyro.csv", stated(**changed), EPOCH)


def test_rates_and_angles_in_any_unit_turn_the_star_camera(tmp_path) -> None:
    rates = np.tile(RATE, (21, 1))
    records = [
        record_of(tmp_path, rates),
        record_of(tmp_path, np.degrees(rates), unit="deg"),
        record_of(tmp_path, rates * STEP_S, quantity="angles"),
        record_of(tmp_path, rates / ARCSEC, unit="arcsec", clock="gps", time_scale="GPS", late=18.0),
    ]
    # A turn of the satellite turns the sky backwards, about the axes of s; the rate is constant.
    expected = Rotation.from_rotvec(-2.0 * R_SG.apply(RATE))
    for one in records:
        assert ((one.R_sz[20] * one.R_sz[0].inv()) * expected.inv()).magnitude() < 1e-9
        np.testing.assert_allclose(one.t_s, STEP_S * np.arange(21), atol=1e-6)
    # what is not stated: a free bias, 1e-3 rad/s, and a resolution of a tenth of the walk over a step
    fine = record_of(tmp_path, rates, white_arcsec=0.5, bias_arcsec_s=30.0)
    unstated = (1e-3, 0.1 * 0.02 * ARCSEC * np.sqrt(STEP_S))
    for noise, rest in ((records[0].noise, unstated), (fine.noise, (30 * ARCSEC, 0.5 * ARCSEC))):
        sizes = (noise.random_walk_rad, noise.bias_walk_rad_s, noise.bias_rad_s, noise.white_rad)
        assert sizes == pytest.approx((0.02 * ARCSEC, 1e-3 * ARCSEC, *rest))


@pytest.mark.parametrize(("gap_s", "is_gap"), [(0.4, True), (0.2, False)])
def test_a_turn_is_too_fast_only_where_rows_follow_each_other(tmp_path, gap_s, is_gap) -> None:
    """Over a gap, of three usual steps, a gyro may have begun to count anew."""
    times = EPOCH.utc_from_seconds([*STEP_S * np.arange(12), 1.1 + gap_s])
    rows = [*(f"{utc},0.001,0.002,-0.003" for utc in times[:-1]), f"{times[-1]},2.0,0.0,0.0"]  # 5 or 10 rad/s
    (tmp_path / "gyro.csv").write_text("\n".join(["utc,x,y,z", *rows]))
    if is_gap:
        record = read_gyro(tmp_path / "gyro.csv", stated(quantity="angles"), EPOCH)
        assert record.t_s[-1] == pytest.approx(1.1 + gap_s, abs=1e-6)
    else:
        with pytest.raises(RawDataError, match="found 10 rad/s by angles in rad"):
            read_gyro(tmp_path / "gyro.csv", stated(quantity="angles"), EPOCH)


def test_rows_around_attitudes_have_no_gap(tmp_path) -> None:
    record = record_of(tmp_path, np.tile(RATE, (50, 1)))
    nominal = ConstantRate(0.0, Rotation.identity(), np.zeros(3))
    near = record.around(np.array([1.0, 2.0]), nominal)
    assert near is not None
    assert (near.t_s[0], near.t_s[-1]) == pytest.approx((0.5, 2.5), abs=0.11)
    assert record.around(np.array([7.0, 8.0]), nominal) is None
    kept = np.r_[0:12, 30:50]
    cut = type(record)(t_s=record.t_s[kept], R_sz=record.R_sz[kept], noise=record.noise)
    assert cut.around(np.array([0.5, 4.0]), nominal) is None
    assert cut.around(np.array([3.2, 4.0]), nominal) is not None


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"unit": "deg", "factor": 1e6}, "rad/s by rates in deg"),
        ({"order": -1}, "strictly increasing times"),
        ({"rows": 1}, "two or more"),
    ],
)
def test_what_is_no_gyro_is_refused(tmp_path, change, found) -> None:
    values = np.tile(RATE, (change.get("rows", 9), 1)) * change.get("factor", 1.0)
    times = EPOCH.utc_from_seconds(STEP_S * np.arange(len(values)))[:: change.get("order", 1)]
    rows = (f"{t},{x},{y},{z}" for t, (x, y, z) in zip(times, values.tolist()))
    (tmp_path / "gyro.csv").write_text("\n".join(["utc,x,y,z", *rows]))
    with pytest.raises(RawDataError, match=found):
        read_gyro(tmp_path / "gyro.csv", stated(unit=change.get("unit", "rad")), EPOCH)


def test_axes_without_unit_length_are_refused() -> None:
    with pytest.raises(ValidationError, match="quaternion_sg has length"):
        stated(quaternion_sg=[0.0, 0.0, 0.0, 0.9])
