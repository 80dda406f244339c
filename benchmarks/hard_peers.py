"""Peers of `star_hard.py` in an interpreter of their own: tetra3rs and cedar-solve identify images or
centroids.

`Peers` starts this file with the other interpreter and talks to it by lines of JSON.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

__all__ = ["Peers"]


def worker() -> None:
    """Runs in the peers' interpreter: one JSON request a line, one answer a line."""
    os.environ.setdefault("RAYON_NUM_THREADS", "1")
    tools = _peer_tools()
    print(json.dumps(list(tools)), flush=True)
    for line in sys.stdin:
        request = json.loads(line)
        start = time.process_time()
        try:
            answer = tools[request["tool"]](np.load(request["file"]), request["fov_deg"])
        except Exception as error:  # a peer's failure is a frame that it does not identify
            answer = None
            print(f"{request['tool']}: {error}", file=sys.stderr)
        print(json.dumps({"at": answer, "cpu_ms": 1e3 * (time.process_time() - start)}), flush=True)


def _peer_tools() -> dict:
    import tetra3
    import tetra3rs
    from PIL import Image

    wide = tetra3rs.SolverDatabase.generate_from_gaia(
        None, max_fov_deg=60.0, min_fov_deg=6.0, star_max_magnitude=8.0, epoch_proper_motion_year=1991.25
    )
    cedar = tetra3.Tetra3("default_database")

    def by_tetra3rs(data, fov):
        if data.ndim == 2 and data.shape[1] > 2:
            shape, stars = data.shape, tetra3rs.extract_centroids(data, threads=1).centroids
        else:
            shape, middle = tuple(data[0].astype(int)), 0.5 * (data[0, ::-1] - 1)
            stars = np.column_stack([data[1:] - middle, np.arange(len(data) - 1, 0, -1.0)])
        found = wide.solve_from_centroids(
            stars, fov_estimate_deg=fov, fov_max_error_deg=0.1 * fov, image_shape=shape
        )
        return [found.ra_deg, found.dec_deg] if hasattr(found, "ra_deg") else None

    def by_cedar(data, fov):
        known = {"fov_estimate": fov, "fov_max_error": 0.1 * fov, "solve_timeout": 5000}
        if data.shape[1] > 2:
            top = float(data.max())
            grey = Image.fromarray((data.astype(float) * (255.0 / top)).astype(np.uint8))
            found = cedar.solve_from_image(grey, **known)
        else:
            found = cedar.solve_from_centroids(data[1:, ::-1] + 0.5, tuple(data[0]), **known)
        return None if found["RA"] is None else [float(found["RA"]), float(found["Dec"])]

    return {"tetra3rs": by_tetra3rs, "cedar-solve": by_cedar}


class Peers:
    """The worker, as this side sees it."""

    def __init__(self, python: str, folder: Path) -> None:
        self.file = folder / "image.npy"
        self.process = subprocess.Popen(
            [python, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.names = list(self._answer())

    def _answer(self) -> list | dict:
        assert self.process.stdout is not None
        while line := self.process.stdout.readline():
            if line[0] in "{[":
                return json.loads(line)
        raise SystemExit("the peers' interpreter ended")

    def run(self, tool: str, fov_deg: float) -> list[float] | None:
        """Right ascension and declination, deg, that a peer finds for the file."""
        assert self.process.stdin is not None
        print(json.dumps({"tool": tool, "file": str(self.file), "fov_deg": fov_deg}), file=self.process.stdin)
        self.process.stdin.flush()
        return self._answer()["at"]


if __name__ == "__main__":
    worker()
