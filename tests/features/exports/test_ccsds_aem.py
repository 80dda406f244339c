"""The attitude message, read back by the package `ccsds-ndm` and turned as the standard's text says."""

import numpy as np
import pytest
from astropy.time import Time
from scipy.spatial.transform import Rotation

from boresight.features.exports.ccsds_aem import AemHeader, attitude_message, comprehensive_message

R_CI = Rotation.from_rotvec(np.outer(np.linspace(2.9, 3.4, 7), [0.48, -0.6, 0.64]))  # through half a turn
UTC = [f"2025-03-20T02:31:0{n}.250000000" for n in range(7)]
HEADER = AemHeader(creation_utc="2025-03-21T00:00:00", object_name="TESTSAT", object_id="2025-001A")


def matrix_a_to_b(q1, q2, q3, qc):
    """CCSDS 504.0-B, annex on conventions: takes components in frame A to components in frame B."""
    return np.array(
        [
            [q1**2 - q2**2 - q3**2 + qc**2, 2 * (q1 * q2 + q3 * qc), 2 * (q1 * q3 - q2 * qc)],
            [2 * (q1 * q2 - q3 * qc), -(q1**2) + q2**2 - q3**2 + qc**2, 2 * (q2 * q3 + q1 * qc)],
            [2 * (q1 * q3 + q2 * qc), 2 * (q2 * q3 - q1 * qc), -(q1**2) - q2**2 + q3**2 + qc**2],
        ]
    )


def test_attitudes_are_read_back_by_another_program():
    ndm_io = pytest.importorskip("ccsds_ndm.ndm_io", reason="the reader ccsds-ndm is not installed")
    message = ndm_io.NdmIo().from_string(attitude_message(HEADER, ["strip S01"], UTC, R_CI))
    segment = message.body.segment[0]
    assert segment.metadata.object_name == "TESTSAT"
    assert segment.metadata.attitude_type.value == "QUATERNION"
    states = segment.data.attitude_state
    assert [state.quaternion_state.epoch for state in states] == UTC
    for n, state in enumerate(states):
        q = state.quaternion_state.quaternion
        got = matrix_a_to_b(*(float(getattr(q, name)) for name in ("q1", "q2", "q3", "qc")))
        assert got == pytest.approx(R_CI[n].as_matrix(), abs=1e-14)  # 15 decimals are written


def test_times_are_instants_of_the_time_system_that_a_message_names():
    """By astropy: 02:31:00.25 UTC is another instant by 69 s if it is called TT."""
    expected = Time(UTC[0], scale="utc").tai
    for text, key in (
        (attitude_message(HEADER, [], UTC, R_CI), "START_TIME"),
        (comprehensive_message(HEADER, [], UTC, R_CI, np.ones((7, 3))), "EPOCH_TZERO"),
    ):
        said = dict(line.split(" = ") for line in text.splitlines() if " = " in line)
        assert abs((Time(said[key], scale=said["TIME_SYSTEM"].lower()).tai - expected).sec) < 1e-9


def test_neighbouring_quaternions_do_not_change_sign():
    lines = attitude_message(HEADER, [], UTC, R_CI).splitlines()
    rows = lines[lines.index("DATA_START") + 1 : lines.index("DATA_STOP")]
    q = np.array([[float(value) for value in row.split()[1:]] for row in rows])
    assert np.all(np.einsum("ni,ni->n", q[1:], q[:-1]) > 0.9)


def test_a_single_attitude_is_refused():
    with pytest.raises(ValueError, match="two or more"):
        attitude_message(HEADER, [], UTC[:1], R_CI[:1])


def test_a_comprehensive_message_holds_attitudes_and_variances():
    # ccsds-ndm 3.1 drops the metadata and packed lines of an ACM in KVN: they are read here by the standard.
    sigma_rad = np.array([[1e-6, 2e-6, 3e-5]] * 7)
    text = comprehensive_message(HEADER, ["strip S01"], UTC, R_CI, sigma_rad**2)
    assert f"EPOCH_TZERO = {UTC[0]}" in text.splitlines()
    lines = text.splitlines()
    blocks = {
        name: [line for line in lines[lines.index(f"{name}_START") + 1 : lines.index(f"{name}_STOP")]]
        for name in ("ATT", "COV")
    }
    keys = {name: dict(x.split(" = ") for x in block if "=" in x) for name, block in blocks.items()}
    assert keys["ATT"]["ATT_TYPE"] == "QUATERNION" and keys["COV"]["COV_TYPE"] == "ANGLE"
    values = {
        name: np.array([x.split() for x in block if "=" not in x], dtype=float)
        for name, block in blocks.items()
    }
    assert values["ATT"][:, 0].tolist() == values["COV"][:, 0].tolist() == [0, 1, 2, 3, 4, 5, 6]
    for n, q in enumerate(values["ATT"][:, 1:]):
        assert matrix_a_to_b(*q) == pytest.approx(R_CI[n].as_matrix(), abs=1e-14)
    assert np.sqrt(values["COV"][:, 1:]) == pytest.approx(np.degrees(sigma_rad), rel=1e-8)  # deg
