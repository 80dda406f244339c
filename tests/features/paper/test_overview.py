"""`boresight experiment all`: one page with every experiment and the paper's printed figures."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from drawn_pictures import OURS, SERIES_COLOURS, shows_curves

from boresight.features.paper.geometry_search import GeometrySearch
from boresight.features.paper.paper_page import run_all, verdict_of
from boresight.features.paper.paper_tables import TABLE_4_RMS_ARCSEC, TABLE_5
from boresight.features.paper.tables import EXPERIMENTS
from boresight.features.paper.vector_experiments import ExperimentSettings
from boresight.pipeline.report.page import template


@pytest.fixture(scope="module")
def all_run(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, pd.DataFrame], Path]:
    """Tables of all experiments, and the page beside their files."""
    settings = ExperimentSettings(
        runs=2,
        wang_runs=2,
        table5_runs=1,
        table5_strips=2,
        table5_check_strips=1,
        wang_strips=2,
        frames=(5, 20),
        table4_frames=20,
        inputs_strips=20,
        grid_sigma_s_px=(0.05, 0.10),
        grid_sigma_c_px=(0.1, 1.0),
        search=GeometrySearch(
            from_zenith_deg=np.array([0.0, 30.0]), azimuth_deg=np.array([0.0, 45.0]), roll_deg=np.zeros(1)
        ),
    )
    return run_all(tmp_path_factory.mktemp("paper"), settings, template("experiments.html.j2"))


@pytest.fixture(scope="module")
def page(all_run: tuple[dict[str, pd.DataFrame], Path]) -> str:
    return all_run[1].read_text(encoding="utf-8")


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_an_experiment_leaves_a_table_a_plot_and_a_record(
    all_run: tuple[dict[str, pd.DataFrame], Path], name: str
) -> None:
    tables, folder = all_run[0], all_run[1].parent
    assert set(tables) == set(EXPERIMENTS)
    assert {path.name for path in folder.glob(f"{name}.*")} == {
        f"{name}.{kind}" for kind in ("csv", "png", "txt")
    }
    assert len(pd.read_csv(folder / f"{name}.csv")) == len(tables[name])
    assert any(shows_curves(folder / f"{name}.png", colour) for colour in (OURS, *SERIES_COLOURS))
    record = (folder / f"{name}.txt").read_text(encoding="utf-8")
    assert all(f"\n{word} " in record for word in ("commit", "date", "machine", "versions", "command"))
    assert "paper" in record
    gaps = set(tables[name].columns[tables[name].isna().any()])
    assert gaps <= ({"at", "paper", "expected"} if name == "inputs" else set())  # not every input has them


def test_the_page_holds_every_experiment_with_table_and_picture(page: str):
    for name in EXPERIMENTS:
        section = re.search(rf'<section id="{name}">(.*?)</section>', page, re.DOTALL)
        assert section is not None
        assert section[1].count('src="data:image/png;base64,') == 1
        assert section[1].count('<th scope="row">') >= 3
        assert "paper" in section[1]
    assert all(f">{word}</th>" in page for word in ("commit", "date", "machine", "versions", "command"))


def test_the_page_holds_the_paper_s_figures(page: str):
    cells = set(re.findall(r"<td>([^<]*)</td>", page))
    printed = [f"{value:.4f}" for who in TABLE_4_RMS_ARCSEC.values() for value in who]
    printed += [f"{value:.2f}" for row in TABLE_5.values() for value in row]
    printed += ["0.0159", "0.0105", "0.0927", "0.2", "0.5"]
    assert not [value for value in printed if value not in cells]


def test_the_page_needs_no_other_file(page: str):
    assert not re.search(r"https?:|@import|<script|<link (?!rel=\"icon\" href=\"data:,\")", page)
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]*)"', page))


@pytest.mark.parametrize(
    ("ours", "paper", "verdict"),
    [(1.0, -1.2, "reproduced"), (0.5, 1.0, "better, 2.0 times"), (2.0, 1.0, "larger, 2.0 times")],
)
def test_a_verdict_compares_sizes(ours: float, paper: float, verdict: str):
    assert verdict_of(ours, paper) == verdict
