"""Names with control characters, newlines or other scripts: no export fails, no message gains a line."""

import io
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from astropy.io import fits
from orbiting_camera import NOTES
from scipy.spatial.transform import Rotation
from test_ground_points import POINTS

from boresight.features.exports.ccsds_aem import AemHeader, attitude_message
from boresight.features.exports.ground_control_points import points_asp, points_envi
from boresight.features.exports.kml import kml_text
from boresight.features.exports.spice_export import SpiceFrames, frame_kernel
from boresight.features.exports.star_fits import centroids_fits
from boresight.features.exports.vrt import vrt_with_gcps
from boresight.geometry.epoch import Epoch
from boresight.geometry.geoid import egm96
from boresight.geometry.sightings import StarSightings, isotropic_covariance

HOSTILE = ["a\nMETA_STOP\nb", "\x1b[31mred\x07", "tab\tnul\x00", "\u2028line \u202ertl", "卫星", "x" * 500]


@pytest.mark.parametrize("name", HOSTILE)
def test_fits_of_a_hostile_mission_is_read_back(name):
    u = np.tile([[0.0, 0.0, 1.0]], (2, 1))
    rows = {"hip": np.array([1, 2]), "xy_px": np.zeros((2, 2)), "cov_s": isotropic_covariance(u, 1e-6)}
    star = StarSightings(exposure_id=name, t_s=1.0, u_s=u, u_i=u, **rows)
    raw = centroids_fits([star], Epoch.from_utc("2025-03-20T02:31:07Z"), replace(NOTES, mission=name))
    with fits.open(io.BytesIO(raw)) as file:
        file.verify("exception")
        assert file[1].header["MISSION"].isprintable()
        assert len(file[1].data) == 2


@pytest.mark.parametrize("name", HOSTILE)
def test_an_attitude_message_keeps_its_lines(name):
    def lines(text):
        header = AemHeader(creation_utc="2025-03-21T00:00:00", object_name=text)
        utc = ["2025-03-20T02:31:00", "2025-03-20T02:31:01"]
        return attitude_message(header, [text], utc, Rotation.identity(2)).splitlines()

    assert len(lines(name)) == len(lines("TESTSAT"))
    assert lines(name).count("META_STOP") == 1


@pytest.mark.parametrize("name", HOSTILE)
def test_other_texts_keep_their_lines(name):
    points = replace(POINTS, image=name)  # two of its three points are used
    assert len(points_envi(points, NOTES, egm96()).splitlines()) == 7 + len(NOTES.lines())
    *notes, one, other = points_asp(points, NOTES).splitlines()
    assert len(notes) == len(NOTES.lines()) and len(one.split()) == len(other.split()) == 12
    assert ElementTree.fromstring(kml_text({name: np.eye(2)}, [points], NOTES)) is not None
    assert ElementTree.fromstring(vrt_with_gcps(Path(name), (2, 2), "Byte", points, NOTES)) is not None
    kernel = frame_kernel(Rotation.identity(), f"{name}\n\\begindata", SpiceFrames())
    assert kernel.count("\n\\begindata\n") == 1
