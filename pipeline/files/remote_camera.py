"""Read and write remote_camera.toml: a camera described by its hardware, or by tables of look directions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from boresight.geometry.line_camera import Ccd, LineCamera, LookAngleCamera, LookTable
from boresight.pipeline.errors import RawDataError, refusing
from boresight.pipeline.files import dump_schema as schema
from boresight.pipeline.files.text_files import path_inside, read_table, read_toml, toml_tables
from boresight.pipeline.files.text_tables import write_csv, write_toml

__all__ = ["read_remote_camera", "remote_camera_table", "write_remote_camera"]

RemoteCamera = tuple[LineCamera, schema.RemoteCameraFile] | tuple[LookAngleCamera, schema.LookCameraFile]


def read_remote_camera(root: Path, path: Path, file: str) -> RemoteCamera:
    """The camera of a dump, and what its file says; `RawDataError` for a camera that cannot exist."""
    if toml_tables(path, file).get("model") == schema.LOOK_TABLES:
        looks = read_toml(path, schema.LookCameraFile, file)
        return _from_tables(root, looks, file), looks
    hardware = read_toml(path, schema.RemoteCameraFile, file)
    return _from_hardware(hardware, file), hardware


def _from_hardware(file: schema.RemoteCameraFile, name: str) -> LineCamera:
    ccds = []
    for n, ccd in enumerate(file.ccds):
        with refusing(name, f"ccds.{n}", "a possible detector"):
            ccds.append(
                Ccd(
                    n_px=ccd.n_px,
                    y_first_m=ccd.y_first_mm * 1e-3,
                    x_offset_m=ccd.x_offset_mm * 1e-3,
                    rotation_rad=ccd.rotation_mrad * 1e-3,
                    pixel_m=ccd.pixel_pitch_um * 1e-6,
                    principal_sample=ccd.principal_sample,
                    distortion_samples=np.array(ccd.distortion_samples, dtype=float),
                    distortion_offsets_m=np.array(ccd.distortion_offsets_um, dtype=float) * 1e-6,
                    across_offsets_m=np.array(ccd.distortion_across_um, dtype=float) * 1e-6,
                )
            )
    return LineCamera(file.focal_length_m, tuple(ccds), file.tdi_stages, file.time_of_row)


def _from_tables(root: Path, file: schema.LookCameraFile, name: str) -> LookAngleCamera:
    path = path_inside(root, file.looks, file=name, field="looks")
    rows = read_table(path, schema.LookRow, file.looks)
    table = np.array([[row.ccd, row.sample, row.x, row.y] for row in rows], dtype=float).reshape(-1, 4)
    if len(rows) and table[:, 0].max() >= len(file.ccds):
        raise RawDataError(file.looks, "ccd", int(table[:, 0].max()), f"0 to {len(file.ccds) - 1}")
    ccds = []
    for n, ccd in enumerate(file.ccds):
        _, samples, *looks = table[table[:, 0] == n].T
        x, y = np.tan(looks) if file.directions == "angles" else looks
        with refusing(file.looks, f"CCD {n}", "looks along a detector"):
            ccds.append(LookTable(ccd.n_px, samples, x, y))
    with refusing(file.looks, "x, y", "looks along a detector"):  # looks that run to and fro
        return LookAngleCamera(tuple(ccds))


def write_remote_camera(root: Path, camera: LineCamera | LookAngleCamera, bits: int) -> None:
    """Write remote_camera.toml to a dump, and looks.csv for a camera of look tables; `bits` as below."""
    if isinstance(camera, LineCamera):
        write_toml(root / "remote_camera.toml", remote_camera_table(camera, bits))
        return
    rows = [
        [n, *values]
        for n, ccd in enumerate(camera.ccds)
        for values in np.column_stack([ccd.samples, ccd.tan_x, ccd.tan_y]).tolist()
    ]
    write_csv(root / "looks.csv", ["ccd", "sample", "x", "y"], rows)
    head = {"model": schema.LOOK_TABLES, "looks": "looks.csv", "directions": "tangents"}
    depth = {"bit_depth": bits} if bits else {}
    ccds = {"ccds": [{"n_px": int(ccd.n_px)} for ccd in camera.ccds]}
    write_toml(root / "remote_camera.toml", head | depth | ccds)


def remote_camera_table(camera: LineCamera, bits: int) -> dict[str, Any]:
    """The keys of remote_camera.toml; `bits` is its bit_depth, 0: no strip has an image."""
    return {
        "focal_length_m": camera.focal_m,
        "tdi_stages": camera.tdi_stages,
        "time_of_row": camera.time_of_row,
        **({"bit_depth": bits} if bits else {}),
        "ccds": [
            {
                "n_px": ccd.n_px,
                "pixel_pitch_um": _rounded(ccd.pixel_m * 1e6),
                "y_first_mm": _rounded(ccd.y_first_m * 1e3),
                "x_offset_mm": _rounded(ccd.x_offset_m * 1e3),
                "rotation_mrad": _rounded(ccd.rotation_rad * 1e3),
                "principal_sample": ccd.principal_sample,
                "distortion_samples": np.asarray(ccd.distortion_samples, dtype=float).tolist(),
                "distortion_offsets_um": [_rounded(v * 1e6) for v in np.asarray(ccd.distortion_offsets_m)],
            }
            | _across(ccd)
            for ccd in camera.ccds
        ],
    }


def _across(ccd: Ccd) -> dict[str, list[float]]:
    """Distortion across a detector, if it has any."""
    values = [_rounded(v * 1e6) for v in np.asarray(ccd.across_offsets_m)]
    return {"distortion_across_um": values} if values else {}


def _rounded(value: float) -> float:
    """The value to 14 digits, without the rounding error of a change of units."""
    return float(f"{value:.14g}")
