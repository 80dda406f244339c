"""The two cameras of a scenario: as their makers calibrated them, and the line camera as it really is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from boresight.geometry.installation import deviation_from_theta
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.geometry.star_camera import StarCamera
from boresight.simulator import scenario

__all__ = [
    "calibrated_line_camera",
    "distorted_line_camera",
    "installation_of_scenario",
    "measured_installation",
    "star_camera",
]

Array = NDArray[np.float64]


def star_camera(settings: scenario.StarCameraSettings) -> StarCamera:
    """The star camera (paper, Table 2); simulated images are exactly those of its calibration."""
    same = {name: getattr(settings, name) for name in "width_px height_px principal_px p1 p2 q1 q2".split()}
    return StarCamera(focal_m=settings.focal_mm * 1e-3, pixel_m=settings.pixel_um * 1e-6, **same)


def calibrated_line_camera(settings: scenario.LineCameraSettings) -> LineCamera:
    """The remote-sensing camera as calibrated (paper, Table 3): every CCD with the same distortion table.

    The table is filled by `offset = -(a r^3 + b r^5)`, r from the principal sample, through the two printed
    entries. Neighbours share `overlap_px` samples, the field is centred on the optical axis.
    """
    samples = np.asarray(np.linspace(0.0, settings.samples - 1.0, settings.distortion_nodes), dtype=float)
    offsets = _distortion_law_m(samples, settings)
    pixel_m = settings.pixel_um * 1e-6

    def along(sample: float) -> float:
        offset = _distortion_law_m(np.array([sample]), settings)[0]
        return float((sample - settings.principal_sample) * pixel_m - offset)

    start, end = along(0.0), along(settings.samples - 1.0)
    pitch = along(settings.samples - settings.overlap_px) - start
    middle = 0.5 * (start + end + (settings.ccds - 1) * pitch)
    ccds = tuple(
        Ccd(
            n_px=settings.samples,
            y_first_m=n * pitch - middle - settings.principal_sample * pixel_m,
            x_offset_m=(n % 2 - 0.5) * settings.stagger_mm * 1e-3,
            rotation_rad=settings.rotation_urad[n] * 1e-6,
            pixel_m=pixel_m,
            principal_sample=settings.principal_sample,
            distortion_samples=samples,
            distortion_offsets_m=offsets,
        )
        for n in range(settings.ccds)
    )
    return LineCamera(settings.focal_m, ccds, tdi_stages=settings.tdi_stages, time_of_row="middle")


def distorted_line_camera(
    calibrated: LineCamera, errors: scenario.ErrorSettings, rng: np.random.Generator
) -> LineCamera:
    """The camera as it is: on top of the tables a smooth Gaussian process along the detectors, another one
    across them, of the same rms, and what each CCD has for itself (`ErrorSettings.ccd_px`).

    Their mean over the field stays: the stated error of a look vector holds it, and so does the estimate.
    """
    tables = [ccd.distortion_samples for ccd in calibrated.ccds]
    places = np.concatenate([ccd.focal_plane(ccd.distortion_samples)[:, 1] for ccd in calibrated.ccds])
    pixel_m = calibrated.ccds[0].pixel_m
    distance = (places[:, None] - places) / (errors.distortion_length_px * pixel_m)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * distance**2))

    def drawn(rms_px: float) -> Array:
        return rms_px * vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(places)))

    def of_each_ccd() -> Array:
        return np.concatenate([_own_of_ccd(table, errors.ccd_px, rng) for table in tables])

    along, across = drawn(errors.distortion_px), drawn(errors.distortion_px)
    if any(errors.ccd_px):
        along, across = along + of_each_ccd(), across + of_each_ccd()
    ends = np.cumsum([len(table) for table in tables])[:-1]
    ccds = [
        replace(
            ccd,
            distortion_offsets_m=ccd.distortion_offsets_m + along_px * pixel_m,
            across_offsets_m=across_px * pixel_m,
        )
        for ccd, along_px, across_px in zip(calibrated.ccds, np.split(along, ends), np.split(across, ends))
    ]
    return replace(calibrated, ccds=tuple(ccds))


def _own_of_ccd(samples: Array, rms_px: tuple[float, float, float], rng: np.random.Generator) -> Array:
    """Shift, slope and bend of one CCD at its samples (N,), px, each of that rms over the CCD."""
    t = 2.0 * (samples - samples[0]) / (samples[-1] - samples[0]) - 1.0
    shapes = np.stack([np.ones_like(t), np.sqrt(3.0) * t, np.sqrt(5.0) * (1.5 * t**2 - 0.5)])
    return np.asarray((rng.standard_normal(3) * rms_px) @ shapes)


def measured_installation(settings: scenario.InstallationSettings) -> Rotation:
    """R_cs0: star camera -> remote-sensing camera, as measured on the ground."""
    tilt, azimuth = np.radians(settings.zenith_distance_deg), np.radians(settings.azimuth_deg)
    z_c = np.array([np.sin(tilt) * np.cos(azimuth), np.sin(tilt) * np.sin(azimuth), -np.cos(tilt)])
    side = np.array([np.cos(azimuth + np.pi / 2), np.sin(azimuth + np.pi / 2), 0.0])
    axes = np.column_stack([side, np.cross(z_c, side), z_c])
    return Rotation.from_matrix(axes) * Rotation.from_rotvec([0.0, 0.0, np.radians(settings.turn_deg)])


def installation_of_scenario(settings: scenario.InstallationSettings) -> Rotation:
    """True R_cs of a scenario, exp[[theta]] R_cs0 (paper, eqs. 11, 12 and 28)."""
    return deviation_from_theta(np.array(settings.theta_rad)) * measured_installation(settings)


def _distortion_law_m(samples: Array, settings: scenario.LineCameraSettings) -> Array:
    known = np.array(settings.distortion_um)
    r = known[:, 0] - settings.principal_sample
    a, b = np.linalg.solve(np.column_stack([r**3, r**5]), known[:, 1] * 1e-6)
    distance = samples - settings.principal_sample
    return np.asarray(a * distance**3 + b * distance**5)
