"""A target on its way from the chip to its measured position: `python scripts/figures/target_path.py`."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import rasterio
from matplotlib.figure import Figure
from style import Ink, draw

from boresight.gct_match.records import TargetMatch
from boresight.pipeline.files.dump import open_dump
from boresight.pipeline.run.settings import Settings
from boresight.pipeline.stages.strip import StripTask, strip_matches
from boresight.pipeline.stages.strip_tasks import strips_to_match

FIXTURE = Path(__file__).parents[2] / "fixtures" / "mini"
ERROR_SCALE = 1000.0


@cache  # for both versions
def best_match() -> tuple[StripTask, TargetMatch, np.ndarray]:
    """A strip's most precise target, starting from the pre-launch matrix, and its chip."""
    tasks, _ = strips_to_match(open_dump(FIXTURE), Settings())
    task = tasks[0]
    found, _ = strip_matches(task)
    assert found is not None
    match = min(found.matches, key=lambda m: float(np.trace(m.cov_px)))
    (chip,) = [c for t, c in zip(task.targets, task.chips) if t.target_id == match.target_id]
    with rasterio.open(chip.path) as stored:
        return task, match, stored.read(1)


def paint(ink: Ink) -> Figure:
    task, match, chip = best_match()
    template, found, surface = match.template, match.found, match.surface
    h, w = template.shape
    x, y = np.round(match.xy_px).astype(int)
    reach = max(h, w)
    y0, y1 = max(y - reach, 0), min(y + reach, task.strip.lines)
    x0, x1 = max(x - reach, 0), min(x + reach, task.camera.n_px(match.ccd))
    window = task.strip.images.read(match.ccd, y0, y1, x0, x1)
    pictures = {
        "chip (ortho-image)": chip,
        "template in strip geometry": template,
        "window of the raw strip": window,
        "correlation surface": surface,
        f"measured, σ × {ERROR_SCALE:.0f}": found,
    }
    figure, panels = plt.subplots(1, 5, figsize=(13.5, 3.1), gridspec_kw={"wspace": 0.08})
    for panel, (title, picture) in zip(panels, pictures.items()):
        edges = (x0 - 0.5, x1 - 0.5, y1 - 0.5, y0 - 0.5) if picture is window else None
        panel.imshow(picture, cmap="viridis" if picture is surface else "gray", extent=edges)
        panel.set_title(title, color=ink.text, fontsize=11)
        panel.set_xticks([])
        panel.set_yticks([])
        panel.set_xlabel(f"{picture.shape[1]} px", color=ink.text)
    corner = match.xy_px - 0.5 * np.array([w, h])
    panels[2].add_patch(plt.Rectangle(corner, w, h, fill=False, ec="#ffb27a", lw=1.6))
    row, column = np.unravel_index(np.argmax(surface), surface.shape)
    panels[3].plot(column, row, "o", mfc="none", mec="white", ms=12)
    sx, sy = ERROR_SCALE * np.sqrt(np.diag(match.cov_px))
    panels[4].errorbar(0.5 * (w - 1), 0.5 * (h - 1), xerr=sx, yerr=sy, fmt="+", color="#ffb27a", lw=1.6, ms=9)
    panels[4].set_xlabel(
        f"σ = {np.sqrt(match.cov_px[0, 0]):.4f}, {np.sqrt(match.cov_px[1, 1]):.4f} px", color=ink.text
    )
    return figure


if __name__ == "__main__":
    draw("target_path", paint)
