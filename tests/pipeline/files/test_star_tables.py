"""A user's star catalogue in three formats, and what is refused."""

import numpy as np
import pytest
from astropy.table import Table
from pytest import approx

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.files.star_tables import StarTable, read_star_table, survey_of

MAS = 1e-3 * ARCSEC
STARS = {
    "source_id": [4472832130942575872, 5853498713190525696],  # Gaia DR3: Barnard's star, Proxima Centauri
    "ra": [269.448502525438, 217.392321472009],
    "dec": [4.739420051112412, -62.676075117],
    "ref_epoch": [2016.0, 2016.0],
    "pmra": [-801.551, -3781.741],
    "pmdec": [10362.394, 769.465],
    "parallax": [546.976, 768.067],
    "phot_g_mean_mag": [8.194, 8.985],
    "ra_error": [0.03, 0.02],
    "dec_error": [0.03, 0.04],
    "pmra_error": [0.03, 0.03],
    "pmdec_error": [0.04, 0.02],
}


FORMS = {"csv": {"format": "ascii.csv"}, "fits": {"format": "fits"}}
FORMS |= {
    f"{form}.vot": {"format": "votable", "tabledata_format": form}
    for form in ("binary", "binary2", "tabledata")
}


@pytest.mark.parametrize("form", FORMS)
def test_a_table_of_the_gaia_archive_is_read_in_every_format(tmp_path, form):
    path = tmp_path / f"stars.{form}"
    Table(STARS).write(path, **FORMS[form])
    stars, mas = read_star_table(path, path.name), {name: np.array(STARS[name]) * MAS for name in STARS}
    places = stars.places
    assert places.hip.tolist() == STARS["source_id"]
    assert np.degrees([places.ra_rad, places.dec_rad]) == approx(
        np.array([STARS["ra"], STARS["dec"]]), abs=1e-12
    )
    assert places.pm_ra_rad_yr * np.cos(places.dec_rad) == approx(mas["pmra"])
    assert places.pm_dec_rad_yr == approx(mas["pmdec"])
    assert places.parallax_arcsec == approx([0.546976, 0.768067])
    assert places.epoch_jyear == 2016.0
    for sigma, of in ((stars.sigma_rad, ""), (stars.sigma_pm_rad_yr, "pm")):  # rms of two axes
        assert sigma == approx(np.hypot(mas[f"{of}ra_error"], mas[f"{of}dec_error"]) / 2**0.5)
    # ten years later: the position's error, and ten times that of the motion
    assert stars.sigma_at_rad(2026.0)[0] == approx(np.hypot(0.03, 10.0 * np.hypot(0.03, 0.04) / 2**0.5) * MAS)


def test_a_table_that_was_replaced_under_the_same_name_is_read_anew(tmp_path):
    table = StarTable("stars.csv", tmp_path / "stars.csv")
    for ra in (269.4, 17.5):
        Table(STARS | {"ra": [ra, 217.4]}).write(table.path, format="ascii.csv", overwrite=True)
        assert np.degrees(survey_of(table).places.ra_rad[0]) == approx(ra, abs=1e-12)
        assert survey_of(table) is survey_of(table)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"ra": [400.0, 1.0]}, "ra"),
        ({"ref_epoch": [2016.0, 2015.5]}, "ref_epoch"),
        ({"pmra": None}, "pmra"),
        ({"source_id": [1.5, 2.5]}, "source_id"),
        ({"phot_g_mean_mag": ["bright", "faint"]}, "phot_g_mean_mag"),
    ],
)
def test_wrong_columns_are_named(tmp_path, change, field):
    columns = {name: values for name, values in (STARS | change).items() if values is not None}
    path = tmp_path / "stars.csv"
    Table(columns).write(path, format="ascii.csv")
    with pytest.raises(RawDataError, match=field):
        read_star_table(path, path.name)


def test_other_formats_and_entities_are_refused(tmp_path):
    (tmp_path / "stars.txt").write_text("ra dec")
    with pytest.raises(RawDataError, match="one of"):
        read_star_table(tmp_path / "stars.txt", "stars.txt")
    (tmp_path / "stars.vot").write_text('<!DOCTYPE a [<!ENTITY b "c">]><VOTABLE>&b;</VOTABLE>')
    with pytest.raises(RawDataError, match="XML"):
        read_star_table(tmp_path / "stars.vot", "stars.vot")
