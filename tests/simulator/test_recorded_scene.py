"""Scenes as they were when they were last looked at: landscape, clouds, a star image with all its faults, a
line camera as it is. Tests of single properties allow for noise; these notice any change.
"""

from dataclasses import replace

import numpy as np
from recorded_numbers import assert_recorded

from boresight.simulator.cameras import calibrated_line_camera, distorted_line_camera
from boresight.simulator.ground import ProceduralGround
from boresight.simulator.landscape import Landscape
from boresight.simulator.lattice_noise import fractal, smooth_noise
from boresight.simulator.scenario import CloudSettings, GroundSettings, SkySettings, mini_scenario
from boresight.simulator.sky import expose, hot_pixels

COLUMN, ROW = 200_000, -7_900_000  # somewhere in a UTM zone, texels of 0.5 m


def test_landscape_is_the_recorded_one():
    found = {}
    for key in (5, 6):
        landscape = Landscape(GroundSettings(), key, date=key % 2)
        for n, shapes in enumerate(landscape.shapes(100_000.0, 3_950_000.0, 102_500.0, 3_952_500.0)):
            x = shapes.corners - [100_000.0, 3_950_000.0]
            found |= {f"{key} corners {n}": x, f"{key} tones {n}": shapes.tones}
    assert_recorded("landscape", found)


def test_reflectance_is_the_recorded_one():
    clouds = replace(GroundSettings(), cloud=CloudSettings(cover=0.4, size_km=0.7))
    found = {
        f"{name} of date {date}": ProceduralGround(settings, 0.5, 5, date).patch(COLUMN, ROW, 400, 300)
        for name, settings in (("clear", GroundSettings()), ("clouds", clouds))
        for date in (0, 1)
    }
    found["fractal"] = np.concatenate(list(fractal(-50, 301, 400, 300, 9, 6, 0.8)))
    x = np.linspace(-7.0, 12.0, 500)
    found["smooth"] = smooth_noise(x, 3.0 - 1.7 * x, 11)
    assert_recorded("reflectance", found)


def test_star_image_with_all_its_faults_is_the_recorded_one():
    uneven = {"background_gradient_dn": (9.0, -5.0), "background_bow_dn": 7.0, "psf_sigma_corner_px": 2.2}
    sky = replace(SkySettings(), **uneven, hot_pixels=30, cosmic_rays=40.0)
    rng = np.random.default_rng(3)
    start = rng.uniform(-4.0, (164.0, 124.0), (60, 2))  # some beyond the edges
    paths = start[:, None] + np.linspace(0.0, 3.0, 5)[None, :, None] * rng.normal(size=(60, 1, 2))
    charge_e = rng.uniform(500.0, 90_000.0, 60)
    image = expose(paths, charge_e, (160, 120), sky, hot_pixels(160, 120, sky, rng), rng)
    found = {"image": image, "first rows": image[:9], "last columns": image[:, -9:]}
    assert_recorded("star_image", found)


def test_line_camera_as_it_is_is_the_recorded_one():
    scenario = mini_scenario()
    errors = replace(scenario.errors, ccd_shift_px=0.3, ccd_slope_px=0.2, ccd_bend_px=0.4)
    plain = calibrated_line_camera(scenario.line_camera)
    camera = distorted_line_camera(plain, errors, np.random.default_rng(4))
    found = {}
    for n, ccd in enumerate(camera.ccds):
        found |= {f"along {n}": ccd.distortion_offsets_m, f"across {n}": ccd.across_offsets_m}
    assert_recorded("line_camera", found)


def test_the_darkest_and_the_brightest_ground_have_the_stated_reflectance():
    rough = ProceduralGround(replace(GroundSettings(), detail=30.0), 0.5, 5, 0).patch(COLUMN, ROW, 300, 300)
    assert (rough.min(), rough.max()) == (np.float32(0.01), np.float32(0.95))
