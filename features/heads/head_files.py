"""What `boresight noise` and `boresight heads` write and print."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import chdtrc

from boresight.features.heads.alignment import HeadAlignment, HeadsAlone
from boresight.geometry.attitude_noise import AttitudeNoise
from boresight.geometry.constants import ARCSEC
from boresight.pipeline.files.stated_noise import noise_keys
from boresight.pipeline.files.whole_file import write_figure, write_json, write_text
from boresight.pipeline.head_noise.of_dump import HeadNoise
from boresight.pipeline.head_noise.spectrum import allan_deviation
from boresight.pipeline.report.panels import GREY, SERIES, panels
from boresight.records.record import Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["heads_json", "heads_lines", "noise_json", "noise_lines", "write_heads", "write_noise"]

# Most components of the differences of heads that a figure draws.
MOST_SIGNALS = 3


def noise_lines(found: HeadNoise) -> list[str]:
    """The noise of each head about its own axes, the test of white noise, and the scatter of means."""
    fit = found.fit
    lines = [f"{'arcsec about the axes of':26s}" + "".join(f"{axis:>16s}" for axis in "xyz")]
    for name, noise, sigma, told in zip(found.names, fit.heads, fit.sigma_log, fit.told_apart):
        rows = (
            ("white", noise.white_rad / ARCSEC, sigma[:, 0]),
            ("correlated", noise.correlated_rad / ARCSEC, sigma[:, 1]),
            ("correlation time, s", noise.correlation_time_s, sigma[:, 2]),
        )
        lines.append(name)
        lines += [
            f"  {what:24s}" + "".join(f"{f'{v:.2f} ± {v * s:.2f}':>16s}" for v, s in zip(values, sigmas))
            for what, values, sigmas in rows
        ]
        if len(found.names) > 1:
            lines.append(f"  {'told apart, %':24s}" + "".join(f"{100.0 * part:16.0f}" for part in told))
        constant = "".join(f"{value / ARCSEC:16.2f}" for value in noise.constant_rad)
        lines.append(f"  {f'constant over {fit.mean_s:.0f} s':24s}{constant}")
        if noise.constant_time_s.any():
            lines.append(f"  {'lasting, s':24s}" + "".join(f"{t:16.0f}" for t in noise.constant_time_s))
    if len(found.names) > 1:
        lines.append("what is not told apart is taken to be alike: of two heads the sum is measured")
    p = float(chdtrc(fit.white_dof, max(fit.white_statistic, 0.0)))
    verdict = "refuted" if p < 1e-4 else "not refuted"
    lines.append(f"white noise alone: {verdict} (likelihood ratio {fit.white_statistic:.1f}, p {p:.1e})")
    if fit.n_means > 1:
        lines.append(f"means over {fit.mean_s:.1f} s, {fit.n_means} of them, arcsec, component by component:")
        for what, values in (
            ("scatter found", fit.scatter),
            ("by white and correlated", fit.predicted),
            ("by white alone", fit.predicted_white),
        ):
            lines.append(f"  {what:24s}" + "".join(f"{value / ARCSEC:16.3f}" for value in values))
    return [*lines, "errors that outlast the record do not show in it; state them with constant_time_s"]


def write_noise(found: HeadNoise, out: Path) -> tuple[Path, ...]:
    """`noise.toml` with the keys for dump.toml, `noise.json` and `noise.png`, in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    files = tuple(out / f"noise.{ending}" for ending in ("toml", "json", "png"))
    text = "\n".join(_toml(name, noise) for name, noise in zip(found.names, found.fit.heads))
    write_text(files[0], text)
    write_json(files[1], noise_json(found))
    write_figure(files[2], _noise_figure(found))
    return files


def _toml(name: str, noise: AttitudeNoise) -> str:
    keys = (f"{key} = {json.dumps(values)}" for key, values in noise_keys(noise, with_white=True).items())
    return "\n".join([f"[star_cameras.noise]  # of {name}", *keys, ""])


def noise_json(found: HeadNoise) -> dict[str, Any]:
    """The noise of the heads for programs."""
    fit = found.fit
    heads = [
        {
            "name": name,
            "white_arcsec": (noise.white_rad / ARCSEC).tolist(),
            "correlated_arcsec": (noise.correlated_rad / ARCSEC).tolist(),
            "correlation_time_s": noise.correlation_time_s.tolist(),
            "constant_arcsec": (noise.constant_rad / ARCSEC).tolist(),
            "constant_time_s": noise.constant_time_s.tolist(),
            "sigma_log": sigma.tolist(),
            "told_apart": told.tolist(),
        }
        for name, noise, sigma, told in zip(found.names, fit.heads, fit.sigma_log, fit.told_apart)
    ]
    return {
        "heads": heads,
        "white_statistic": fit.white_statistic,
        "white_dof": fit.white_dof,
        "mean_s": fit.mean_s,
        "n_means": fit.n_means,
        "scatter_arcsec": (fit.scatter / ARCSEC).tolist(),
        "predicted_arcsec": (fit.predicted / ARCSEC).tolist(),
        "predicted_white_arcsec": (fit.predicted_white / ARCSEC).tolist(),
    }


def _noise_figure(found: HeadNoise) -> Figure:
    """Spectrum and Allan deviation of each component of the signal, measured and by the fit."""
    fit, signal = found.fit, found.signal
    shown = min(signal.values.shape[1], MOST_SIGNALS)
    figure, ((left, right),) = panels(1, 2, 3.4)
    unit = ARCSEC**2 * (1.0 / signal.step_s)  # to arcsec² per Hz, two-sided
    longest = max(signal.pieces, key=lambda piece: piece.stop - piece.start)
    times, deviation = allan_deviation(signal.values[longest], signal.step_s)
    for n in range(shown):
        colour, dash, marker = SERIES[n]
        name = "xyz"[n]
        spectrum = fit.spectrum
        left.loglog(
            spectrum.frequency_hz, spectrum.measured[:, n] / unit, marker, color=colour, ms=4, mfc="none"
        )
        left.loglog(
            spectrum.frequency_hz, spectrum.model[:, n] / unit, dash, color=colour, label=f"{name}, fit"
        )
        left.axhline(float(spectrum.white[0, n]) / unit, color=colour, lw=0.7, alpha=0.5)
        right.loglog(times, deviation[:, n] / ARCSEC, marker, color=colour, ms=4, mfc="none")
        white = np.sqrt(fit.spectrum.white[0, n] / (times / signal.step_s)) / ARCSEC
        right.loglog(times, white, color=colour, lw=0.7, alpha=0.5)
        right.loglog(times, _model_allan(found, n, times) / ARCSEC, dash, color=colour, label=f"{name}, fit")
    left.set(xlabel="frequency, Hz", ylabel="spectral density, arcsec² / Hz")
    right.set(xlabel="averaging time, s", ylabel="Allan deviation of means, arcsec")
    for axes in (left, right):
        axes.legend(fontsize=8, frameon=False)
    what = " and ".join(found.names)
    kind = "difference of " if len(found.names) > 1 else "attitude of "
    figure.suptitle(f"{kind}{what}: marks measured, thin lines white noise alone", fontsize=10)
    return figure


def _model_allan(found: HeadNoise, component: int, times: Floats) -> Floats:
    """Allan deviation (M,) of one component of the signal by the fit, rad."""
    signal, total = found.signal, np.zeros(len(times))
    for enters, noise in zip(signal.enters, found.fit.heads):
        for axis in range(3):
            r = np.exp(-signal.step_s / noise.correlation_time_s[axis])
            for k, m in enumerate(np.round(times / signal.step_s).astype(int).tolist()):
                inner = np.arange(1 - m, m)
                within = np.sum((m - np.abs(inner)) * r ** np.abs(inner)) / m**2
                weights = np.convolve(np.ones(m), np.ones(m))
                between = np.sum(weights * r ** np.arange(1, 2 * m)) / m**2
                variance = noise.white_rad[axis] ** 2 / m + noise.correlated_rad[axis] ** 2 * (
                    within - between
                )
                total[k] += enters[component, axis] ** 2 * variance
    return np.sqrt(total)


def heads_lines(found: HeadsAlone) -> list[str]:
    """Each alignment with its error, its difference from what is stated, and its changes."""
    lines: list[str] = []
    for one, stated in zip(found.alignments, found.stated):
        difference = (one.R_sh * stated.inv()).as_rotvec()
        statistic = float(difference @ np.linalg.solve(one.covariance_s, difference))
        quaternion = "".join(f"{value:+13.9f}" for value in one.R_sh.as_quat(canonical=True))
        z_stated = float(np.arccos(np.clip(stated.apply([0, 0, 1])[2], -1.0, 1.0)))
        off = (one.angle_rad - z_stated) / ARCSEC
        sigmas = abs(off) * ARCSEC / one.sigma_angle_rad
        lines += [
            f"{one.head} to {found.reference}, {one.n_rows} common instants",
            f"  {'quaternion, scalar last':26s}{quaternion}",
            f"{'  1 sigma about x y z, arcsec':30s}{_numbers(np.sqrt(np.diag(one.covariance_s)))}",
            f"{'  against the stated matrices':30s}{_numbers(difference)}",
            f"    chi2 {statistic:.1f} of 3, p {float(chdtrc(3, statistic)):.1e}",
            f"  angle between lines of sight {np.degrees(one.angle_rad):.5f} deg ± "
            f"{one.sigma_angle_rad / ARCSEC:.2f} arcsec, stated {np.degrees(z_stated):.5f} deg: "
            f"{off:+.2f} arcsec, {sigmas:.1f} sigma",
        ]
        for term in one.terms:
            lines.append(f"{f'  per {term.name}, arcsec':30s}{_numbers(term.value)}")
            lines.append(f"{'    1 sigma':30s}{_numbers(term.sigma)}")
        lines.append(_offset_line(one))
    return lines


def _offset_line(one: HeadAlignment) -> str:
    if not one.sigma_time_offset_s < 1.0:
        return "  time offset: not observable, the satellite turns evenly"
    return (
        f"  time offset {1e3 * one.time_offset_s:+.2f} ms ± {1e3 * one.sigma_time_offset_s:.2f} ms (late: +)"
    )


def _numbers(values: Floats) -> str:
    return "".join(f"{value / ARCSEC:+10.3f}" for value in values)


def heads_json(found: HeadsAlone) -> dict[str, Any]:
    """The alignments for programs."""
    return {
        "reference": found.reference,
        "noise": noise_json(found.noise),
        "alignments": [
            {
                "head": one.head,
                "quaternion_sh": one.R_sh.as_quat(canonical=True).tolist(),
                "covariance_rad2": one.covariance_s.tolist(),
                "angle_deg": float(np.degrees(one.angle_rad)),
                "sigma_angle_arcsec": one.sigma_angle_rad / ARCSEC,
                "stated_quaternion_sh": stated.as_quat(canonical=True).tolist(),
                "terms": [
                    {"per": t.name, "rad": t.value.tolist(), "sigma_rad": t.sigma.tolist()} for t in one.terms
                ],
                "time_offset_s": one.time_offset_s,
                "sigma_time_offset_s": one.sigma_time_offset_s,
                "rows": one.n_rows,
            }
            for one, stated in zip(found.alignments, found.stated)
        ],
    }


def write_heads(found: HeadsAlone, out: Path) -> tuple[Path, ...]:
    """`heads.json` and `heads.png` in the folder `out`."""
    out.mkdir(parents=True, exist_ok=True)
    files = (out / "heads.json", out / "heads.png")
    write_json(files[0], heads_json(found))
    figure, every = panels(len(found.alignments), 1, 2.4)
    for one, axes in zip(found.alignments, every[:, 0]):
        for n, (colour, _, marker) in enumerate(SERIES):
            axes.errorbar(
                one.block_t_s + 0.004 * (n - 1) * np.ptp(one.block_t_s),
                one.block_s[:, n] / ARCSEC,
                one.block_sigma[:, n] / ARCSEC,
                fmt=marker,
                ms=4,
                lw=1,
                capsize=2,
                color=colour,
                label="xyz"[n],
            )
        axes.axhline(0.0, color=GREY, lw=0.8)
        axes.set_title(
            f"{one.head} against {found.reference}, about the axes of {found.reference}", fontsize=9
        )
        axes.set(ylabel="arcsec", xlabel="seconds since the dump's epoch")
        axes.legend(fontsize=8, frameon=False, ncols=3)
    write_figure(files[1], figure)
    return files
