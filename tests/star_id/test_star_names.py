"""Names of bright stars."""

import csv
from importlib.resources import files

import numpy as np
import pytest
from astropy import units
from astropy.coordinates import SkyCoord, get_constellation
from skyfield.named_stars import named_star_dict

from boresight.star_id.catalogue import hipparcos_stars
from boresight.star_id.star_names import star_name

# Names that the IAU gave to other stars than older lists, as Skyfield's, do: Algenib was alpha Persei, Gienah
# epsilon Cygni, Markab kappa Velorum, Toliman alpha Centauri A.
MOVED = {"Algenib": 1067, "Gienah": 59803, "Markab": 113963, "Toliman": 71681}
GREEK = "αβγδεζηθικλμνξοπρστυφχψω"


@pytest.fixture(scope="module")
def rows():
    text = (files("boresight.star_id") / "data" / "star_names.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def test_names_are_those_of_skyfields_list(rows):
    ours = {row["name"]: int(row["hip"]) for row in rows if row["name"]}
    both = named_star_dict.keys() & ours.keys()
    assert len(both) >= 85  # of 119, the others being older spellings
    assert {name: ours[name] for name in both if ours[name] != named_star_dict[name]} == MOVED


def test_a_bayer_designation_belongs_to_one_star_in_its_constellation(rows):
    lettered = [row for row in rows if row["bayer"]]
    assert len({row["bayer"] for row in lettered}) == len(lettered) > 1400
    places = hipparcos_stars().places
    at = np.searchsorted(places.hip, [int(row["hip"]) for row in lettered])
    sky = SkyCoord(places.ra_rad[at] * units.rad, places.dec_rad[at] * units.rad)
    lies_in = get_constellation(sky, short_name=True).tolist()
    assert [row["bayer"].split()[1] for row in lettered] == lies_in
    assert {row["bayer"][0] for row in lettered} == set(GREEK)


@pytest.mark.parametrize(
    ("hip", "name"),  # from general knowledge
    [(17702, "Alcyone"), (91262, "Vega"), (11767, "Polaris"), (27989, "Betelgeuse"), (8102, "τ Cet")],
)
def test_well_known_stars_have_their_names(hip, name):
    assert star_name(hip) == name


def test_a_star_without_name_or_letter_is_its_number(rows):
    assert star_name(17684) == "HIP 17684"


def test_all_are_stars_of_the_catalogue_to_its_limit(rows):
    hips = [int(row["hip"]) for row in rows]
    assert hips == sorted(set(hips)) and set(hips) <= set(hipparcos_stars().places.hip.tolist())
