"""Exposures in the wrong place are named by their attitudes; clean ones and manoeuvres are left alone."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from boresight.geometry.constants import ARCSEC
from boresight.geometry.sightings import exposure_without_stars, solved_attitudes
from boresight.pipeline.diagnosis.exchanged_exposures import exchanged_exposures
from boresight.pipeline.stages.head import HeadSightings

N, STEP_S = 26, 2.4
TIMES_S = 311.0 + STEP_S * np.arange(N)
NAMES = [f"x{k:02d}" for k in range(N)]
ORBIT = SimpleNamespace(R_oi=lambda t_s: Rotation.from_rotvec(np.outer(t_s, [2e-4, -1.0e-3, 3e-4])))
DUMP = SimpleNamespace(orbit=ORBIT)
MOUNTING = Rotation.from_euler("xyz", [-35.0, 70.0, 115.0], degrees=True)


def attitudes(seed: int, sigma_arcsec: float = 4.0, turn_s: float | None = None) -> Rotation:
    """R_si of a camera that turns at a steady rate in the orbital frame, or begins to turn at an instant."""
    rng = np.random.default_rng(seed)
    rate = np.array([4e-4, -7e-4, 2e-4])
    turned = np.maximum(TIMES_S - turn_s, 0.0) if turn_s is not None else TIMES_S
    noise = Rotation.from_rotvec(sigma_arcsec * ARCSEC * rng.normal(size=(N, 3)))
    return noise * MOUNTING * Rotation.from_rotvec(np.outer(turned, rate)) * ORBIT.R_oi(TIMES_S)


def findings(R_si: Rotation, usable: np.ndarray | None = None, sigma_rad: float = 1e-5):
    stars = tuple(exposure_without_stars(name, t) for name, t in zip(NAMES, TIMES_S.tolist()))
    solved = solved_attitudes(R_si, np.tile(sigma_rad**2 * np.eye(3), (N, 1, 1)))
    if usable is not None:
        solved = replace(solved, usable=usable)
    head = HeadSightings(
        head=SimpleNamespace(source=None), stars=stars, attitudes=solved, omissions=(), computed=()
    )
    return exchanged_exposures(DUMP, [head])


@pytest.mark.parametrize("pair", [(3, 8), (5, 6), (6, 11), (2, 4)])
@pytest.mark.parametrize("seed", range(3))
def test_two_exposures_in_each_others_place_are_named(pair, seed):
    order = np.arange(N)
    order[list(pair)] = order[list(pair[::-1])]
    (told,) = findings(attitudes(seed)[order])
    assert told.item == f"exposures {NAMES[pair[0]]} and {NAMES[pair[1]]}"
    assert (told.file, told.field) == ("exposures.csv", "file")


def test_two_pairs_are_two_findings():
    order = np.arange(N)
    order[[2, 5, 18, 21]] = order[[5, 2, 21, 18]]
    assert {one.item for one in findings(attitudes(7)[order])} == {
        "exposures x02 and x05",
        "exposures x18 and x21",
    }


def test_exposures_in_order_have_no_finding():
    assert [findings(attitudes(seed)) for seed in range(200)] == [[]] * 200


def test_a_manoeuvre_has_no_finding():
    for seed in range(50):
        assert findings(attitudes(seed, turn_s=TIMES_S[6] + 0.3)) == []


@pytest.mark.parametrize("wrong", [0, 6, 24])
def test_one_wrong_attitude_is_named_alone(wrong):
    R_si = attitudes(1).as_matrix()
    R_si[wrong] = R_si[wrong] @ Rotation.from_rotvec([0.01, 0.02, -0.01]).as_matrix()
    (told,) = findings(Rotation.from_matrix(R_si))
    assert told.item == f"exposure {NAMES[wrong]}"
    assert told.text.startswith("off the motion")


def test_three_exposures_in_a_circle_are_one_finding():
    order = np.arange(N)
    order[[3, 7, 20]] = order[[7, 20, 3]]
    (told,) = findings(attitudes(5)[order])
    assert told.item == "exposures x03, x07 and x20"


def test_files_that_are_late_by_one_exposure_show_where_the_first_comes_from_elsewhere():
    (told,) = findings(attitudes(9)[np.roll(np.arange(N), 1)])
    assert told.item == "exposure x00"


@pytest.mark.parametrize("seed", range(20))
def test_exposures_without_order_are_told_together(seed):
    (told,) = findings(attitudes(seed)[np.random.default_rng(seed).permutation(N)])
    assert told.item == "exposures x00, x01, x02 and 23 more"
    assert told.text.startswith("attitudes jump")


def test_an_attitude_of_few_stars_may_be_further_off():
    R_si = attitudes(1).as_matrix()
    R_si[6] = R_si[6] @ Rotation.from_rotvec([0.0, 120.0 * ARCSEC, 0.0]).as_matrix()
    assert findings(Rotation.from_matrix(R_si))
    assert findings(Rotation.from_matrix(R_si), sigma_rad=15.0 * ARCSEC) == []


def test_exposures_without_attitude_are_passed_over():
    order, usable = np.arange(N), np.ones(N, dtype=bool)
    order[[3, 9]] = order[[9, 3]]
    usable[5] = False
    (told,) = findings(attitudes(2)[order], usable)
    assert told.item == "exposures x03 and x09"
