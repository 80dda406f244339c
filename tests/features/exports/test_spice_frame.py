"""The frame kernel, loaded by NAIF's own toolkit."""

import numpy as np
import pytest
import spiceypy
from scipy.spatial.transform import Rotation

from boresight.features.exports.spice_export import SpiceFrames, frame_kernel

R_CS = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)


@pytest.fixture
def loaded(tmp_path):
    path = tmp_path / "boresight.tf"
    path.write_text(frame_kernel(R_CS, "a comment\nof two lines", SpiceFrames()))
    spiceypy.furnsh(str(path))
    yield
    spiceypy.kclear()


def test_spice_gives_the_same_rotation(loaded):
    got = spiceypy.pxform("BORESIGHT_STAR_CAMERA", "BORESIGHT_REMOTE_CAMERA", 0.0)
    assert np.abs(got - R_CS.as_matrix()).max() < 1e-12  # rotation matrix elements; 17 decimals are written


def test_spice_knows_both_frames_by_name_and_id(loaded):
    assert spiceypy.namfrm("BORESIGHT_REMOTE_CAMERA") == -999002
    assert spiceypy.frmnam(-999001) == "BORESIGHT_STAR_CAMERA"


@pytest.mark.parametrize("name", ["lower", "WITH SPACE", "X" * 33, ""])
def test_names_that_spice_cannot_take_are_refused(name):
    with pytest.raises(ValueError, match="frame name"):
        SpiceFrames(remote_camera_name=name)
