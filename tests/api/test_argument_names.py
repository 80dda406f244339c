"""One name for one thing: no argument of the public interface is called by a name with its unit in one place
and without it in another.
"""

import inspect
import re

import boresight as bs

UNIT = re.compile(r"_(px|s|deg|dn|arcsec|m|rad|years|ms)$")
# Pairs that are two things: pictures and numbers, test and angles before calibration, dates and seconds,
# axes of c and of s; the size of an image has no unit where lists of centroids are named, as elsewhere.
DIFFERENT = {
    ("times", "times_s"),
    ("residual", "residual_px"),
    ("before", "before_rad"),
    ("template", "template_px"),
    ("theta", "theta_s"),
    ("covariance", "covariance_s"),
    ("size", "size_px"),
}


def argument_names():
    """Each argument of a public function, method or class, with one place that has it."""
    found = {}
    for name in bs.__all__:
        thing = getattr(bs, name)
        functions = {name: thing} if callable(thing) else {}
        if inspect.isclass(thing):
            functions |= {f"{name}.{m}": v for m, v in inspect.getmembers(thing, callable) if m[0] != "_"}
        for place, function in functions.items():
            try:
                arguments = inspect.signature(function).parameters
            except (TypeError, ValueError):
                continue
            found |= dict.fromkeys(arguments, place)
    return found


def test_no_argument_has_its_unit_in_one_place_alone():
    names = argument_names()
    assert len(names) > 150
    pairs = {(UNIT.sub("", name), name) for name in names if UNIT.search(name)}
    assert {pair for pair in pairs if pair[0] in names} <= DIFFERENT


def test_a_point_of_a_strip_is_given_alike_everywhere():
    of_result = inspect.signature(bs.Calibration.geolocate).parameters
    of_folder = inspect.signature(bs.geolocate).parameters
    assert (
        [*of_result][1:]
        == [*of_folder][1:]
        == ["strip", "ccd", "line", "sample", "dump", "camera", "height_m"]
    )
