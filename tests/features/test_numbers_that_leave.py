"""Every number that is printed, exported or written into JSON and CSV, beside one computed independently.

Each record is lopsided: no two axes, units, sigmas, dates, cameras or heads are alike, so that an exchange, a
wrong unit or a wrong frame changes a number. A case gives what is written and what is right; both must hold
the same places, so that a number without a row fails.
"""

import json
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace as Of
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import boresight
from boresight import array_stars, missions
from boresight.calib.error_table import CommonBias
from boresight.calib.estimate import HeadInstallation, InstallationEstimate
from boresight.calib.finding import Finding
from boresight.calib.ground_references import ReferenceOffset
from boresight.calib.heads import PeriodicError
from boresight.calib.information import InformationPairs
from boresight.calib.reliability import HypothesisTest
from boresight.calib.settings import CalibrationSettings
from boresight.calib.verdict import LOOK_AT, TOO_SMALL, Check, CheckKind, Outcome, Verdict
from boresight.features.exports import formats
from boresight.features.exports.csm_isd import parameter_covariance
from boresight.features.exports.spice_export import SpiceFrames, instrument_kernel
from boresight.features.interior import interior_files
from boresight.features.mission import joint_trend, trends
from boresight.features.mission.mounting_comparison import Comparison
from boresight.features.mission.what_if import WhatIf
from boresight.features.targets import target_matches
from boresight.features.vectors import vector_result
from boresight.geometry.constants import ARCSEC
from boresight.geometry.epoch import Epoch
from boresight.geometry.line_camera import Ccd, LineCamera
from boresight.matching import Match
from boresight.pipeline.diagnosis.input_findings import EarthTableCheck
from boresight.pipeline.diagnosis.unused_rows import Rows
from boresight.pipeline.results.requirement import Requirement
from boresight.pipeline.results.sightings_tables import sightings_schema
from boresight.pipeline.results.writing import installation_facts, write_installation
from boresight.pipeline.run.settings import settings_from_tables
from boresight.records.ledger import Entry, Kind, Reason, Subject

R_CS = Rotation.from_euler("xyz", [40.0, -65.0, 110.0], degrees=True)
THETA = np.array([[3e-5, -8e-5, 1.7e-4], [9e-5, 2e-5, -6e-5]])  # of two results, rad
F = np.array([[[9.0, 1, 2], [1, 5, -1], [2, -1, 3]], [[4.0, -1, 1], [-1, 7, 2], [1, 2, 6]]]) * 1e10
UTC = ("2026-02-03T04:05:06Z", "2026-09-08T17:16:06Z")
RESIDUAL = np.array([[1.5, -2.5], [0.25, 7.0], [-4.0, 0.75]]) * ARCSEC  # x and y
SQUARES, WEIGHT = np.array([0.5, 3.25, 9.5]), np.array([1.0, 0.375, 0.0])
PLAIN = {"rotation_rad": 0.0, "principal_sample": 0.0}
CCDS = (Ccd(n_px=400, y_first_m=-0.003, x_offset_m=0.0004, pixel_m=7e-6, **PLAIN),)
CCDS += (Ccd(n_px=300, y_first_m=-0.0005, x_offset_m=-0.0011, pixel_m=7e-6, **PLAIN),)


def places(value: Any, at: str = "") -> dict[str, Any]:
    """Every single value by its path."""
    if isinstance(value, pd.DataFrame):
        value = value.to_dict("list")
    if isinstance(value, Mapping):
        return {k: v for name, item in value.items() for k, v in places(item, f"{at}/{name}").items()}
    if isinstance(value, (list, tuple, np.ndarray, pd.Series)):
        return {k: v for n, item in enumerate(value) for k, v in places(item, f"{at}/{n}").items()}
    return {at: value}


def biases(folder: Path) -> tuple[Any, Any]:
    cov = np.diag([0.5, 1.5, 2.5, 0.0003]) ** 2
    names, stated = ("along", "across", "radial", "clock"), np.array([1.0, 2.0, 3.0, 4.0])
    value = np.array([1.25, -3.5, 7.75, -0.0125])
    bias = CommonBias(names=names, value=value, covariance=cov, stated=stated)
    return bias.texts(), [
        *("along +1.25 ± 0.5 m", "across -3.5 ± 1.5 m", "radial +7.75 ± 2.5 m"),
        "clock -12.5 ± 0.3 ms",
    ]


def residuals_of_vectors(folder: Path) -> tuple[Any, Any]:
    found = Of(strip_id=np.array(["4", "4", "7"]), residual_c=RESIDUAL, statistic=SQUARES)
    found = Of(**vars(found), kept=np.array([True, True, False]), weight=WEIGHT)
    found.detectable_rad = np.array([11.0, 13.0, 17.0]) * ARCSEC
    u_i = np.array([[0.6, 0.48, 0.64], [-0.48, 0.6, 0.64], [0.64, -0.6, 0.48]])
    tilt = np.column_stack([RESIDUAL, np.zeros(3)])
    stars = Of(u_s=R_CS.apply(u_i) + tilt, u_i=u_i, hip=np.array([11, 22, 33]), exposure_id="7")
    starts = {"target_start": np.array([0, 2, 3]), "star_start": np.array([0, 10, 20, 40])}
    given = Of(w_c=u_i, target_id=np.array(["1.5/-2.5/30", "4/5/6", "-7/8/9.5"]), **starts)
    attitudes = Of(R_si=R_CS.as_matrix()[None], usable=[True], kept=found.kept, squared_mahalanobis=SQUARES)
    strip = Of(strip_id="7", fitted=attitudes, exposures=[stars])
    made = {
        "targets": vector_result._target_table(given, Of(estimate=Of(targets=found))),
        "stars": vector_result._star_table(given, Of(strips=[strip])),
    }
    both = {"residual_x_arcsec": [1.5, 0.25, -4.0], "residual_y_arcsec": [-2.5, 7.0, 0.75]}
    both |= {"statistic": SQUARES, "p_value": np.exp(-SQUARES / 2.0), "kept": found.kept}  # 2 dof
    targets = both | {"frame": [0, 0, 1], "target": [0, 1, 0], "weight": WEIGHT}
    targets |= {"detectable_arcsec": [11.0, 13.0, 17.0]}
    targets |= {"lat_deg": [1.5, 4.0, -7.0], "lon_deg": [-2.5, 5.0, 8.0], "height_m": [30.0, 6.0, 9.5]}
    return made, {"targets": targets, "stars": both | {"frame": [1, 2, 2], "star": [1, 2, 13]}}


def residuals_of_a_result(folder: Path) -> tuple[Any, Any]:
    """`targets` and `stars` of a result read back."""
    (folder / "sightings").mkdir()
    xy = np.array([[10.0, 20.5], [30.25, 40.0], [50.0, 60.75]])
    kept = np.array([True, True, False])
    given: dict[str, dict[str, Any]] = {
        "stars": {"exposure_id": ["e1", "e1", "e2"], "hip": [11, 22, 33], "xy_px": xy}
        | {"residual_s": np.column_stack([RESIDUAL, RESIDUAL[:, 0]])},
        "targets": {"strip_id": ["s1", "s2", "s2"], "target_id": ["a", "b", "c"], "ccd": [0, 2, 1]}
        | {"correlation": [0.75, 0.875, 0.625], "weight": WEIGHT, "residual_c": RESIDUAL},
    }
    for name, columns in given.items():
        columns |= {"normalised": SQUARES, "kept": kept}
        schema = sightings_schema(name)
        arrays = {
            f.name: pa.array(list(columns[f.name]), f.type) if f.name in columns else pa.nulls(3, f.type)
            for f in schema
        }
        table = pa.table(arrays).select(list(columns))
        pq.write_table(table, folder / "sightings" / f"{name}.parquet")
    both = {"residual_x_arcsec": [1.5, 0.25, -4.0], "residual_y_arcsec": [-2.5, 7.0, 0.75]}
    both |= {"statistic": SQUARES, "p_value": np.exp(-SQUARES / 2.0), "kept": kept}
    targets = {k: given["targets"][k] for k in ("strip_id", "target_id", "ccd", "correlation", "weight")}
    stars = {"exposure": ["e1", "e1", "e2"], "hip": [11, 22, 33], "x_px": xy[:, 0], "y_px": xy[:, 1]}
    made = {"targets": missions._target_residuals(folder), "stars": missions._star_residuals(folder)}
    return made, {"targets": targets | both, "stars": stars | both}


def lists_of_stars(folder: Path) -> tuple[Any, Any]:
    cov = np.array([[[0.04, 0.01], [0.01, 0.09]], [[0.16, -0.02], [-0.02, 0.25]]])
    more = {"snr": [8.0, 31.0], "saturated": [False, True], "blended": [True, False]}
    more |= {"psf_sigma_px": [1.25, 1.75]}
    stars = Of(xy_px=np.array([[1.5, 9.0], [33.0, 7.25]]), cov_px=cov, flux_dn=np.array([5e3, 700.0]), **more)
    right = {"x_px": [1.5, 33.0], "y_px": [9.0, 7.25], "sigma_x_px": [0.2, 0.4], "sigma_y_px": [0.3, 0.5]}
    right |= {"cov_xy_px2": [0.01, -0.02], "flux_dn": [5e3, 700.0]} | more
    types = {bits: str(array_stars.stored(np.zeros((1, 1), np.uint8), bits).dtype) for bits in (8, 9, 16)}
    right_types = {8: "uint8", 9: "uint16", 16: "uint16"}
    return [array_stars._stars(stars, "stars"), types], [right, right_types]


def matches(folder: Path) -> tuple[Any, Any]:
    numbers = {"ccd": 2, "correlation": 0.875, "probability_wrong": 3e-4, "model": "shift"}
    match = Of(
        target_id="T",
        xy_px=np.array([101.5, 2002.25]),
        cov_px=np.array([[0.04, -0.01], [-0.01, 0.25]]),
        predicted_px=np.array([99.0, 1990.0]),
        residual_px=np.array([0.125, -0.75]),
        **numbers,
    )
    reasons = {"V": Reason.OUTSIDE_CCDS, "U": Reason.OUTSIDE_CHIP}  # what is not in view has no row
    refusals = [
        Entry(Subject(Kind.TARGET, strip="S", ccd=1, id=name), why, "why", "chip.tif")
        for name, why in reasons.items()
    ]
    found = Of(matches=[match], refused=refusals, theta_vote=np.array([1e-4, -2e-4, 3e-4]))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(target_matches, "strip_matches", lambda task: (found, []))
        (line,) = target_matches.matched_lines([Of(strip=Of(strip_id="S"))])
    told = "S   1 matched, 1 refused, theta (+0.000100, -0.000200, +0.000300) rad"
    right = {"strip_id": "S", "target_id": "T", "outcome": "placed", "sample_px": 101.5, "line_px": 2002.25}
    right |= {"sigma_sample_px": 0.2, "sigma_line_px": 0.5, "covariance_px2": -0.01, "reason": ""}
    right |= {"predicted_sample_px": 99.0, "predicted_line_px": 1990.0}
    right |= {"residual_sample_px": 0.125, "residual_line_px": -0.75} | numbers
    refused = dict.fromkeys(right, math.nan) | {"strip_id": "S", "target_id": "U", "ccd": 1}
    refused |= {"outcome": "refused", "reason": refusals[1].text}
    return [line.text, *target_matches.matches_table([line]).to_dict("records")], [told, right, refused]


def results_shown(folder: Path) -> tuple[Any, Any]:
    """What a match, two matrices, a changed result and a comparison print and list."""
    sigma = np.array([0.5, 1.5, 2.5, 0.75, 1.25, 4.0])
    of_cov, off = np.diag((sigma * ARCSEC) ** 2), np.array([3.0, -1.0, 4.0]) * ARCSEC
    match = Of(
        xy_px=np.array([84.25, 90.5]), cov_px=np.array([[0.04, 0.01], [0.01, 0.25]]), correlation=0.875
    )
    match = Of(**vars(match), probability_wrong=2e-7, affine=np.zeros((2, 2)), found=np.zeros((48, 64)))
    spot = {"cause": "c", "item": "i", "unit": "m", "is_unseen": True, "hidden_sigma": 2.25}
    pair = {"cameras": ["nadir", "aft"], "p_value": 0.375}
    pair |= {"theta_rad": off, "covariance_rad2": of_cov[3:, 3:]}
    both = missions.Calibration(
        R_cs=Rotation.concatenate([R_CS, R_CS.inv()]),
        theta=np.array([3.0, -1.0, 4.0, -1.5, 9.0, 2.6]) * ARCSEC,
        cov_theta=of_cov,
        counts="17 targets",
        chi2=12.5,
        dof=19,
        targets=pd.DataFrame(),
        not_used=pd.DataFrame(columns=missions.UNUSED),
        facts={"blind_spots": [spot | {"effect_rad": off.tolist()}], "between_cameras": [pair]},
        cameras=("nadir", "aft"),
    )
    left, worse = of_cov[:3, :3], of_cov[3:, 3:]
    asked = WhatIf(shift=off, covariance=worse, covariance_now=left, strips=("s1", "s2"))
    named = {"id": "b", "utc": UTC[1], "ground_m_per_rad": np.array([5e5, 7e5, 6e3])}
    compared = Comparison(
        first=Of(id="a", utc=UTC[0], pair=Of(shared=("distortion",))),
        second=Of(**named),
        theta_c=off,
        covariance_c=left,
        theta_s=-off[::-1],
        covariance_s=worse,
        chi2=6.5,
        dof=3,
        common_strips=("s1", "s2"),
        shares_camera=True,
        false_alarm=0.01,
        differing=(),
    )
    made = [Match.table(match), both.blind_spots, both.between_cameras, asked.table()]
    made += [" ".join(one.split()) for one in (Match.summary(match), both.summary())]
    made += [" ".join(one.summary().split()) for one in (asked, compared)]
    axes, bars = asked.plot(), compared.plot().containers[0]
    made += [[line.get_ydata() for line in axes.lines], [text.get_text() for text in axes.get_legend().texts]]
    made += [[bars.lines[0].get_ydata(), *(part[:, 1] for part in bars.lines[2][0].get_segments())]]
    right: list[Any] = [
        {"x_px": [84.25], "y_px": [90.5], "sigma_x_px": [0.2], "sigma_y_px": [0.5]}
        | {"correlation": [0.875], "probability_wrong": [2e-7]},
        [spot | xyz("effect", [3.0, -1.0, 4.0])],
        [
            {"a": "nadir", "b": "aft", "p_value": 0.375}
            | xyz("theta", [3.0, -1.0, 4.0])
            | xyz("sigma", sigma[3:])
        ],
        [
            {"quantity": what} | dict(zip(("x_arcsec", "y_arcsec", "z_arcsec"), values))
            for what, values in (
                ("shift", [3.0, -1.0, 4.0]),
                ("1 sigma", sigma[3:]),
                ("1 sigma now", sigma[:3]),
            )
        ],
    ]
    right[1:] = [pd.DataFrame(one) for one in right[1:]]
    p = 2.0 * chi2(19).cdf(12.5), chi2(3).sf(6.5)
    return made, [
        *right,
        "found at (84.250 +- 0.200, 90.500 +- 0.500) px correlation 0.875, wrong with probability 2.0e-07 "
        "translation of 64 x 48 px",
        "R_cs of nadir: theta X +3.000 +- 0.500, Y -1.000 +- 1.500, Z +4.000 +- 2.500 arcsec "
        "R_cs of aft: theta X -1.500 +- 0.750, Y +9.000 +- 1.250, Z +2.600 +- 4.000 arcsec "
        f"not assessed chi2 / dof 12.5 / 19 (p {p[0]:.2g}) from 17 targets not used: nothing",
        "from 2 strips X Y Z shift 3.0000 -1.0000 4.0000 1 sigma 0.7500 1.2500 4.0000 "
        "1 sigma now 0.5000 1.5000 2.5000",
        "a of 2026-02-03 and b of 2026-09-08 X Y Z difference, frame c, arcsec +3.0000 -1.0000 +4.0000 "
        "1 sigma +0.5000 +1.5000 +2.5000 on the ground, m +7.2722 +3.3937 +0.1164 "
        "difference, frame s, arcsec -4.0000 +1.0000 -3.0000 1 sigma +0.7500 +1.2500 +4.0000 "
        "shared, so not independent: 2 strips and the camera's distortion "
        f"no sign that the matrices differ: chi2 / dof 6.50 / 3, p {p[1]:.3g} "
        "0 inputs, settings or versions differ",
        [sigma[3:], sigma[:3]],
        ["1 sigma", "1 sigma now"],
        [[3.0, -1.0, 4.0], [2.5, 3.5], [-2.5, 0.5], [1.5, 6.5]],
    ]


def trend(folder: Path) -> tuple[Any, Any]:
    """Two results: one matrix by weighted least squares, and the step that explains their difference."""
    R_cs0 = Rotation.from_rotvec([4e-4, -2e-4, 1e-4]) * R_CS
    names = ["late", "early"]  # in another order than their dates
    saved = {
        folder / name: Of(
            id=f"id-{name}",
            folder=(folder / name).resolve(),
            t_s=joint_trend_t_s(UTC[n]),
            utc=UTC[n],
            model="m",
            star_camera="c",
            R_cs0=R_cs0,
            cos_sin=np.full(2, np.nan),
            beta_rad=np.nan,
            temperature_c=np.nan,
            pair=InformationPairs(np.array([name]), F[n : n + 1], (F[n] @ THETA[n])[None], R_CS),
        )
        for name, n in (("late", 1), ("early", 0))
    }
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(joint_trend, "read_saved_mounting", saved.__getitem__)
        joint_trend.trend_of_dumps(folder, names)
    made = json.loads((folder / "drift.json").read_text())
    of_course = made.pop("course")
    assert set(of_course) >= {"terms", "steps", "random_walk"}  # as in test_mounting_course.py
    assert of_course["dof"] == 0 and of_course["p_value"] == 1.0  # a mean and a step, two results
    mean = np.linalg.solve(F.sum(axis=0), F[0] @ THETA[0] + F[1] @ THETA[1])
    cov = np.linalg.inv(F.sum(axis=0))
    apart, of_each = THETA[1] - THETA[0], np.linalg.inv(F)
    gain = apart @ np.linalg.solve(of_each.sum(axis=0), apart)
    R = Rotation.from_rotvec(-mean) * R_CS
    first, last = (pd.Timestamp(one).as_unit("ms") for one in UTC)  # 95 % of the time between them
    within = first + 0.025 * (last - first), last - 0.025 * (last - first)
    right = {
        "results": ["early", "late"],
        "utc": list(UTC),
        "moved": True,
        "probability_false_alarm": 0.01,
        "merged": {
            "R_cs": R.as_matrix().tolist(),
            "quaternion": R.as_quat(canonical=True).tolist(),
            "theta_rad": (-(R * R_cs0.inv()).as_rotvec()).tolist(),
            "covariance_rad2": cov.tolist(),
        },
        "constant": {"chi2": gain, "dof": 3, "p_value": chi2(3).sf(gain)},
        "step": {
            "after": "early",
            "before": "late",
            "utc": f"{first + 0.5 * (last - first):%Y-%m-%dT%H:%M:%SZ}",
            "utc_interval": [f"{date:%Y-%m-%dT%H:%M:%SZ}" for date in within],
            "probability": 1.0,
            "is_exchange": False,
            "theta_rad": apart.tolist(),
            "covariance_rad2": of_each.sum(axis=0).tolist(),
            "p_value": chi2(3).sf(gain),
        },
        "version": boresight.__version__,
    }
    table = pd.read_csv(folder / "drift.csv")
    rows = {"result": np.repeat(["early", "late"], 3), "utc": np.repeat(UTC, 3), "axis": [*"XYZXYZ"]}
    rows |= {"theta_arcsec": ((THETA - mean) / ARCSEC).ravel()}
    rows |= {"sigma_arcsec": np.sqrt(np.diagonal(of_each, axis1=1, axis2=2)).ravel() / ARCSEC}
    # With one step between two results the course is what each says alone.
    rows |= {
        f"course{name}_arcsec": rows[f"{of}_arcsec"] for name, of in (("", "theta"), ("_sigma", "sigma"))
    }
    course = table[["course_arcsec", "course_sigma_arcsec"]]
    bands = [ax.collections[0].get_paths()[0] for ax in joint_trend.plot_drift(table, None, "").axes]
    ends = [[path.vertices[:, 1].min(), path.vertices[:, 1].max()] for path in bands]
    low, high = (course["course_arcsec"] + sign * course["course_sigma_arcsec"] for sign in (-1.0, 1.0))
    drawn = [[low[n::3].min(), high[n::3].max()] for n in range(3)]
    return [made, table, ends], [right, rows, drawn]


def required(folder: Path) -> tuple[Any, Any]:
    """The smaller of what metres and arc-seconds allow by the last result; no metres about Z."""
    rows = [{"ground_m_per_rad": text} for text in ("[1.0, 1.0, 1.0]", "[2e6, 1e6, NaN]")]
    asked = [Requirement(arcsec=0.4, m=3.0), Requirement(arcsec=0.4), Requirement(m=3.0), Requirement()]
    angle = 0.4 * ARCSEC
    right = [[1.5e-6, angle, angle], [angle] * 3, [1.5e-6, 3e-6, math.inf], None]
    return [trends.required_rad(Of(rows=rows), one) for one in asked], right


def exported_attitudes(folder: Path) -> tuple[Any, Any]:
    """Attitudes of the camera, half a row before the first to half a row after the last or as far as the
    track goes, and variances C V Cᵀ + cov theta; parameters of an ISD turn by 180 degrees about x.
    """
    cov, own, epoch = lopsided_covariance(3, 1e-6), lopsided_covariance(3, 3e-6), "2026-02-03T04:05:06"
    R_si = Rotation.from_rotvec([[0.3, -0.2, 0.1], [0.31, -0.2, 0.12]])
    track = Of(span_s=(4.5, 5.05), R_si=lambda t_s: R_si, covariance_s=lambda t_s: np.array([own, 4.0 * own]))
    model = Of(pushbroom=Of(instants=lambda rows: 5.0 + 1e-3 * rows), strip=Of(strip_id="S", lines=100))
    calibrated = Of(dump=Of(mission="M", epoch=Epoch.from_utc(epoch)), result=Of(R_cs=R_CS, cov_theta=cov))

    def text_of(header: Any, comments: Any, utc: Any, R_ci: Rotation, variance_c: Any) -> Any:
        t_s = [(pd.Timestamp(one) - pd.Timestamp(epoch)).total_seconds() for one in utc]
        names = header.object_name, header.object_id, header.creation_utc
        return {"t_s": t_s, "R_ci": R_ci.as_matrix(), "variance": variance_c, "names": names}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(formats, "_opened", lambda request: calibrated)
        patch.setattr(formats, "_notes", lambda request: Of(lines=lambda: []))
        patch.setattr(formats, "_models", lambda of, strips: [Of(track=track, **vars(model))])
        patch.setattr(formats, "_line_times", lambda of, since: [])
        patch.setattr(formats, "_instants", lambda of, one, first, last: np.array([first, last]))
        request: Any = Of(strips=(), creation_utc="2026-05-06T00:00:00", object_id="O")
        made = dict(formats._message(request, "aem", text_of))
    C, signs = R_CS.as_matrix(), np.array([1.0, -1.0, -1.0])
    of_camera = C @ own @ C.T
    right = {"t_s": [4.9995, 5.05], "R_ci": C @ R_si.as_matrix(), "names": ("M", "O", "2026-05-06T00:00:00")}
    right |= {"variance": [np.diag(of_camera + cov), np.diag(4.0 * of_camera + cov)]}
    turned = parameter_covariance(cov)["covariance"]
    return [made, turned], [{"S.aem": right}, cov * np.outer(signs, signs)]


def joint_trend_t_s(utc: str) -> float:
    return (pd.Timestamp(utc) - pd.Timestamp("2000-01-01T11:59:28Z")).total_seconds() + 5.0  # 37 - 32 s


def xyz(what: str, values: Any) -> dict[str, float]:
    return {f"{what}_{axis}_arcsec": value for axis, value in zip("xyz", values)}


def in_order(corners: Any) -> list[list[float]]:
    return sorted(np.round(corners, 9).tolist())


def fields_of_view(folder: Path) -> tuple[Any, Any]:
    """Tangents of the corners of both CCDs, by x = -f u_x / u_z and y likewise."""
    camera = LineCamera(focal_m=0.75, ccds=CCDS)
    frames = SpiceFrames()
    text = instrument_kernel(camera, frames, "")
    made, right, ends = {}, {}, []
    for number, rows in re.findall(r"INS(-?\d+)_FOV_BOUNDARY = \(\n(.*?)\)", text, re.S):
        corners = np.array([line.split() for line in rows.strip().splitlines()], dtype=float)
        made[int(number)] = in_order(corners[:, :2] / corners[:, 2:])
        middle = re.search(rf"INS{number}_BORESIGHT = \(([^)]*)\)", text)
        made[f"{number}, boresight"] = np.array(middle[1].split(), dtype=float) - corners.mean(axis=0)
        right[f"{number}, boresight"] = np.zeros(3)
    for n, ccd in enumerate(CCDS):
        y = -(ccd.y_first_m + np.array([-0.5, ccd.n_px - 0.5]) * 7e-6) / 0.75
        x = -ccd.x_offset_m / 0.75 + np.array([-0.5, 0.5]) * 7e-6 / 0.75
        ends.append([[a, b] for a in x for b in y])
        right[frames.remote_camera_id - 1 - n] = in_order(ends[-1])
    every = np.concatenate(ends)
    low, high = every.min(axis=0), every.max(axis=0)
    box = [[x, y] for x in (low[0], high[0]) for y in (low[1], high[1])]
    right[frames.remote_camera_id] = in_order(box)
    return made, right


def interior(folder: Path) -> tuple[Any, Any]:
    """Parameters in their units, and the new focal length behind the old one."""
    old, new = LineCamera(focal_m=0.75, ccds=CCDS), LineCamera(focal_m=0.7503, ccds=CCDS)
    values = {"focal": 4e-4, "shift_along/0": 0.5, "shift_along/1": -1.25, "rotation/0": 3e-6}
    values |= {"rotation/1": -7e-6, "scale/0": 2e-6, "scale/1": 9e-6, "stagger/0": 4e-6, "stagger/1": -5e-6}
    values |= {"shift_across/0": 1.5, "shift_across/1": -2.5, "curve_1/0/1": 0.3, "curve_1/1/1": -0.4}
    sigma = np.array([1e-5, 0.1, 0.2, 1e-6, 2e-6, 3e-7, 5e-7, 6e-7, 8e-7, 0.3, 0.4, 0.05, 0.06])
    estimate = Of(
        sigma_theta=np.array([1.0, 2.0, 3.0]) * ARCSEC,
        cov_theta=np.diag([1.0, 4.0, 9.0]) * ARCSEC**2,
        R_cs=R_CS,
        n_targets=17,
        chi2=21.5,
        dof=19,
    )
    found = Of(
        covariance=np.diag(sigma**2),
        values=np.array([*values.values()]),
        model=Of(names=tuple(values), camera=old),
        camera=new,
        gauges=[Of(name="scale/all", reason="focal")],
        installation=estimate,
        map_change_px=lambda ccd, sample: np.column_stack([ccd + 0.0 * sample, 2.0 + 0.0 * sample]),
        map_sigma_px=lambda ccd, sample: np.full((len(sample), 2), 0.25),
    )
    calibration = Of(found=found, strips=[1, 2, 3, 4])
    rms = math.sqrt((0.0 + 4.0 + 1.0 + 4.0) / 4.0)
    text = "\n".join(interior_files.interior_lines(calibration))
    right = """focal length, m 0.7500000 -> 0.7503000 (+400.0 ± 10.0 ppm)
        shift_along, px shift_across, px
        CCD 0 +0.50 ± 0.10 +1.50 ± 0.30
        CCD 1 -1.25 ± 0.20 -2.50 ± 0.40""".split()
    shown = " ".join(text.split())
    for part in (" ".join(right[:11]), "+3.00 ± 1.00", "-7.00 ± 2.00", "+2.00 ± 0.30", "+9.00 ± 0.50"):
        assert part in shown, (part, shown)
    for part in ("+4.00 ± 0.60", "-5.00 ± 0.80", "+0.50 ± 0.10", "-1.25 ± 0.20", "+1.50 ± 0.30"):
        assert part in shown, (part, shown)
    for part in ("-2.50 ± 0.40", "curve, px", "0.30", "0.40", f"rms px {rms:.3f}", "after it 0.250"):
        assert part in shown, (part, shown)
    assert "1 sigma of the matrix 1.0000 2.0000 3.0000 arcsec" in shown
    return interior_files.interior_json(calibration), {
        "parameters": [
            {"name": name, "value": value, "sigma": s} for (name, value), s in zip(values.items(), sigma)
        ],
        "gauge": [{"name": "scale/all", "not_told_from": "focal"}],
        "map_change_rms_px": rms,
        "map_sigma_rms_px": 0.25,
        "R_cs": R_CS.as_matrix(),
        "covariance_rad2": estimate.cov_theta,
        "strips": 4,
        "targets": 17,
        "chi2": 21.5,
        "dof": 19,
    }


def holding(kind: type, **values: Any) -> Any:
    """A record of a kind with the fields that are needed alone."""
    made = object.__new__(kind)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


R_CS0 = Rotation.concatenate([R_CS, Rotation.from_euler("zyx", [15.0, -25.0, 70.0], degrees=True)])
OFF = np.array([[1e-3, -2e-3, 3.5e-3], [-4e-4, 9e-4, 6e-4]])  # theta of two cameras, rad
STATED = np.array([3e-4, 5e-4, 7e-4, 4e-4, 6e-4, 8e-4])  # 1-sigma of both before launch, rad
RANGE_M = [np.array([510e3, np.nan, 560e3]), np.array([640e3])]  # mean 570 km
ROWS = (Rows("strips", 2, 2), Rows("targets", 17, 23))
EARTH = dict(source="own", first_day=60001, last_day=60999, last_measured_day=60500, sigma_m=0.75)
EARTH |= {"difference_m": 1.5, "difference_ut1_s": -0.0025}
TUNED = {"stars": {"gain_e_per_dn": 41.0}, "run": {"rounds": 3}, "verdict": {"sigma_overstated": 2.5}}


def lopsided_covariance(n: int, scale: float) -> Any:
    """Of which no two entries but mirrored ones are alike."""
    root = np.tril(np.arange(1.0, n * n + 1.0).reshape(n, n) % 7.3 - 2.0) + 9.0 * np.eye(n)
    return scale**2 * root @ root.T


WAVES = {"stated_rad": np.array([1e-5, 2e-5, 4e-5])} | {
    f"{what}_rad": np.arange(6.0).reshape(2, 3) * 1e-6 + n * 1e-5
    for n, what in enumerate(("cosine", "sine", "sigma_cosine", "sigma_sine"), 1)
}


def lopsided_estimate(cameras: int) -> Any:
    R_cs, n = Rotation.from_rotvec(-OFF) * R_CS0, 3 * cameras
    shared = ("reference/a/0/east", "earth/1/x", "bias/along", "earth/1/y")
    offset = {"value_m": np.array([0.5, -1.5, 2.5]), "sigma_m": np.array([0.1, 0.2, 0.3])}
    heads = zip(("port", "zenith", "star"), (R_CS, R_CS**2, R_CS**3))
    return holding(
        InstallationEstimate,
        R_cs=R_cs if cameras > 1 else R_cs[0],
        R_cs0=R_CS0 if cameras > 1 else R_CS0[0],
        cameras=("nadir", "aft") if cameras > 1 else ("",),
        theta=OFF[:cameras].ravel(),
        cov_theta=lopsided_covariance(n, 1e-6),
        **{"chi2": 21.5, "dof": 31, "n_exposures": 42, "n_stars": 3719, "n_targets": 36},
        pairs=Of(shared=shared),
        shared_covariance=lopsided_covariance(4, 1e-3),
        theta_with_shared=np.arange(4.0 * n).reshape(n, 4) * 1e-9,
        targets=Of(doubtful=[[Subject(Kind.TARGET, strip="s1", id=name) for name in ("t3", "t9")]]),
        bias=CommonBias(
            names=("along", "clock"),
            value=np.array([1.25, -0.0125]),
            covariance=np.array([[0.25, 0.01], [0.01, 4e-6]]),
            stated=np.array([2.0, 1e-4]),
        ),
        references=(ReferenceOffset(name="tile 7", stated_m=np.array([3.0, 4.0, 5.0]), **offset),),
        periodic=(PeriodicError(head="zenith", period_s=5920.5, **WAVES),),
        heads=tuple(HeadInstallation(name=name, R_cs=R) for name, R in heads),
        cov_heads=lopsided_covariance(9, 2e-6),
    )


def lopsided_verdict() -> tuple[Verdict, dict[str, Any], list[dict[str, Any]]]:
    """A verdict with what JSON must have of it, and of what the data cannot show."""
    numbers = {"expected": 40.0, "n": 41, "p_plain": 0.07, "limit": 1e-4, "names": (("t1", "t2"),)}
    checks = {  # statistic, p-value: holds, fails, too small, not applicable
        CheckKind.BETWEEN_STRIPS: (44.5, 0.3),
        CheckKind.START_MATRIX: (95.5, 1e-6),
        CheckKind.STAR_RESIDUALS: (5.5, 2e-6),
        CheckKind.ORBIT_BIAS: (0.0, math.nan),
    }
    names = dict.fromkeys(("cause", "item", "unit", "file", "field"), "")
    tests = {  # redundancy, effect and detectable size: unseen twice, hidden, and seen
        "seen": (0.75, 0.5, 2.0),
        "weak": (0.003, 4.0, 50.0),
        "strong": (0.001, 9.0, math.inf),
        "hidden": (0.25, 1.5, 3.0),
    }
    every = [
        HypothesisTest(
            **names | {"cause": cause},
            **{"value": 0.5 * n, "sigma": 0.25 + n, "statistic": 3.0 + n, "p_value": 0.1 / n},
            **{"redundancy": redundancy, "effect_sigma": effect, "detectable": detectable},
            effect_rad=np.array([1.0, -2.0, 3.5]) * 1e-6 * n,
        )
        for n, (cause, (redundancy, effect, detectable)) in enumerate(tests.items(), 1)
    ]
    finding = {"cause": "clock", "item": "s2", "text": "late", "unit": "ms", "file": "a", "field": "b"}
    finding |= {"value": 12.5, "sigma": 0.75, "effect_sigma": 3.25, "p_value": 3e-5}
    effect = {"effect_rad": np.array([4e-6, -5e-6, 6e-6])}
    own = {"probability_false_alarm": 2e-4, "weakest_sigma_rad": 8.5e-6, "dof": 31}
    own |= {"weakest_axis_c": np.array([0.6, 0.48, -0.64])}
    made = Verdict(
        outcome=Outcome.FINDINGS,
        checks=tuple(
            Check(kind=kind, statistic=statistic, p_value=p, **numbers)
            for kind, (statistic, p) in checks.items()
        ),
        findings=(Finding(**finding, **effect),),
        tests=tuple(every),
        **own,
    )
    told = [
        {"kind": kind.value, "statistic": statistic, "p_value": p, **numbers}
        | {"holds": p > 0.1, "fails": p < 1e-4, "is_caution": statistic == 5.5}
        | {"look_at": [one.value for one in (LOOK_AT if statistic != 5.5 else TOO_SMALL)[kind]]}
        for kind, (statistic, p) in checks.items()
    ]
    plain = {"refutes": False, "is_fault": True, "rivals": [], "subjects": [], "explains": []}
    sentence = "consistent, findings: 1 input looks wrong; correct and calibrate again"
    verdict = {"outcome": "consistent, findings", "checks": told, "findings": [finding | effect | plain]}
    verdict |= own | {"sentence": f"{sentence}; used: 17 of 23 targets"}
    spots = []
    for cause in ("strong", "weak", "hidden"):
        n, (redundancy, effect_sigma, detectable) = [*tests].index(cause) + 1, tests[cause]
        one = names | {"cause": cause, "value": 0.5 * n, "sigma": 0.25 + n, "statistic": 3.0 + n}
        one |= {"p_value": 0.1 / n, "detectable": detectable, "redundancy": redundancy}
        one |= {"effect_rad": np.array([1e-6, -2e-6, 3.5e-6]) * n, "effect_sigma": effect_sigma}
        hides = effect_sigma * detectable
        spots.append(one | {"is_unseen": redundancy < 0.01, "hidden_sigma": hides})
    return made, verdict, spots


def rotated(name: str, R: Rotation, theta: Any, covariance: Any) -> dict[str, Any]:
    q = R.as_quat()
    angles = {"theta_rad": theta, "covariance_rad2": covariance}
    return {name: R.as_matrix(), "quaternion": q * np.sign(q[3])} | angles


def installations(folder: Path) -> tuple[Any, Any]:
    """`installation.json` of one camera as it is written, and what it holds of two, each with three heads."""
    settings = settings_from_tables(TUNED, "settings.toml")
    model = CalibrationSettings(sigma_position_m=2.5, sigma_clock_s=3e-4)
    verdict, told, spots = lopsided_verdict()
    one, two = lopsided_estimate(1), lopsided_estimate(2)
    found = {"estimate": one, "verdict": verdict, "rows": ROWS, "settings": model}
    found |= {"strips": [Of(ground=Of(range_m=range_m)) for range_m in RANGE_M]}
    found |= {"camera": LineCamera(focal_m=0.75, ccds=CCDS)}
    found |= {"assessment": Of(earth_table=EarthTableCheck(**EARTH))}
    write_installation(folder, Of(**found), settings)
    grounds = [np.array([5e5, 5e5, 6e3]), np.array([7e5, 7e5, 8e3])]
    made = installation_facts(two, verdict, ROWS, (model, settings), grounds, STATED)
    sections = {name: vars_of(getattr(settings, name)) for name in ("stars", "match", "run", "verdict")}
    sections |= {"sky_strips": vars_of(settings.sky_strips), "calibration": vars_of(model)}
    for section, values in TUNED.items():
        assert values.items() <= sections[section].items()
    earth = [1, 3]  # of the shared unknowns

    def of_all(estimate: Any) -> dict[str, Any]:
        cov = estimate.cov_heads
        heads = [
            {"name": name, "R_cs": R.as_matrix(), "quaternion": R.as_quat(canonical=True)}
            | {"covariance_rad2": cov[3 * n : 3 * n + 3, 3 * n : 3 * n + 3]}
            for n, (name, R) in enumerate(zip(("port", "zenith", "star"), (R_CS, R_CS**2, R_CS**3)))
        ]
        of_earth = {"unknowns": ["earth/1/x", "earth/1/y"]}
        of_earth |= {"covariance": estimate.shared_covariance[earth][:, earth]}
        of_earth |= {"covariance_with_theta_rad": estimate.theta_with_shared[:, earth]}
        bias = {"names": ["along", "clock"], "value": [1.25, -0.0125], "stated": [2.0, 1e-4]}
        reference = {"name": "tile 7", "value_m": [0.5, -1.5, 2.5], "sigma_m": [0.1, 0.2, 0.3]}
        return {
            "verdict": told,
            "blind_spots": spots,
            **{"frames": 42, "stars": 3719, "targets": 36, "chi2": 21.5, "dof": 31},
            "rows": {"strips": {"used": 2, "listed": 2}, "targets": {"used": 17, "listed": 23}},
            "settings": sections,
            "version": boresight.__version__,
            "heads": heads,
            "heads_covariance_rad2": cov,
            "common_bias": bias | {"covariance": [[0.25, 0.01], [0.01, 4e-6]]},
            "predicted_earth": of_earth,
            "ground_references": [reference | {"stated_m": [3.0, 4.0, 5.0]}],
            "periodic_errors": [
                {"head": "zenith", "period_s": 5920.5} | {name: wave.tolist() for name, wave in WAVES.items()}
            ],
            "doubtful_targets": [["s1/t3", "s1/t9"]],
        }

    def of_camera(estimate: Any, n: int, ground: Any) -> dict[str, Any]:
        own = slice(3 * n, 3 * n + 3)
        R = Rotation.from_rotvec(-OFF[n]) * R_CS0[n]
        z, x, y = np.degrees(Rotation.from_rotvec(OFF[n]).as_euler("ZXY"))
        matrix = rotated("R_cs", R, OFF[n], estimate.cov_theta[own, own])
        return matrix | {"euler_zxy_deg": [x, y, z], "ground_m_per_rad": ground}

    edge = max(math.hypot(-one.x_offset_m, one.y_first_m) for one in CCDS) / 0.75
    right = of_all(one) | of_camera(one, 0, 570e3 * np.array([1.0, 1.0, edge]))
    right |= {"earth_orientation": EARTH}
    a, b = (Rotation.from_rotvec(-OFF[n]) * R_CS0[n] for n in (0, 1))
    lift = np.hstack([np.eye(3), -(a * b.inv()).as_matrix()])
    moved = -((a * b.inv()) * (R_CS0[0] * R_CS0[1].inv()).inv()).as_rotvec()
    apart = lift @ (two.cov_theta + np.diag(STATED**2)) @ lift.T
    p = chi2(3).sf(moved @ np.linalg.solve(apart, moved))
    between = {"cameras": ["nadir", "aft"], "p_value": p, "as_before_launch": p > 1e-3}
    between |= rotated("R_ab", a * b.inv(), moved, lift @ two.cov_theta @ lift.T)
    cameras = [{"name": n} | of_camera(two, k, grounds[k]) for k, n in enumerate(("nadir", "aft"))]
    several = {"cameras": cameras, "between_cameras": [between], "cameras_covariance_rad2": two.cov_theta}
    return [json.loads((folder / "installation.json").read_text()), made], [right, of_all(two) | several]


def vars_of(settings: Any) -> dict[str, Any]:
    return {name: getattr(settings, name) for name in settings.__dataclass_fields__}


CASES: dict[str, Callable[[Path], tuple[Any, Any]]] = {
    "calib/error_table.py": biases,
    "features/vectors/vector_result.py": residuals_of_vectors,
    "boresight/missions.py": residuals_of_a_result,
    "boresight/array_stars.py": lists_of_stars,
    "features/targets/target_matches.py": matches,
    "features/mission/joint_trend.py": trend,
    "features/mission/trends.py": required,
    "features/exports/formats.py": exported_attitudes,
    "features/exports/spice_export.py": fields_of_view,
    "features/interior/interior_files.py": interior,
    "pipeline/results/writing.py": installations,
    "boresight/matching.py": results_shown,
}


@pytest.mark.parametrize("module", CASES)
def test_every_number_that_leaves_is_the_one_computed_independently(module: str, tmp_path: Path) -> None:
    made, right = map(places, CASES[module](tmp_path))
    assert made.keys() == right.keys()
    for place, value in right.items():
        if made[place] is None:  # JSON has no number for it
            assert value is None or not math.isfinite(value), place
        elif isinstance(value, str):
            assert made[place] == value, place
        else:  # of CSV nine digits are written
            assert made[place] == pytest.approx(value, rel=1e-6, abs=1e-15, nan_ok=True), place


# Modules that write JSON or CSV and have no case here: the tests that compare what they write.
ELSEWHERE = {
    "features/exports/csm_isd.py": "features/exports/test_csm_isd.py",
    "features/exports/ground_control_points.py": "features/exports/test_ground_points.py",
    "features/exports/operator_parameters.py": "features/exports/test_operator_parameters.py",
    "features/heads/head_files.py": "features/heads/test_noise_and_heads.py",
    "features/mission/archive.py": "features/mission/test_archive.py",
    "features/mission/trends_command.py": "features/mission/test_archive.py",
    "features/operators/point_import.py": "features/operators/test_measured_points.py",
    "features/paper/tables.py": "features/paper/test_overview.py",
    "features/planning/plan_command.py": "features/planning/test_plan.py",
    "features/planning/scan_files.py": "features/planning/test_sky_scans.py",
    "features/simulation/simulate_command.py": "pipeline/calibration/test_calibrate.py",
    "features/sky_images/centroid_report.py": "features/sky_images/test_centroid_lists.py",
    "features/sky_images/field_plan.py": "features/sky_images/test_sky_plan.py",
    "features/sky_images/identify_command.py": "features/sky_images/test_star_commands.py",
    "features/sky_images/star_camera_report.py": "features/sky_images/test_star_commands.py",
}
WRITES = re.compile(r"(?<!def )\b(write_json|table_csv|csv_line|json_text|json\.dumps)\(")


def test_every_module_that_writes_numbers_is_compared() -> None:
    root = Path(__file__).parents[2]
    files = [*(root / "features").rglob("*.py"), *(root / "boresight").glob("*.py")]
    writers = {file.relative_to(root).as_posix() for file in files if WRITES.search(file.read_text("utf-8"))}
    assert writers == (writers & CASES.keys()) | ELSEWHERE.keys()
    assert not CASES.keys() & ELSEWHERE.keys()
    assert all((root / "tests" / test).is_file() for test in ELSEWHERE.values())
