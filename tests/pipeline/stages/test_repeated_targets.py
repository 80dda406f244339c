"""A dump whose targets are listed several times gives the result of each target once, and says so."""

import json
from pathlib import Path

import numpy as np
import pytest
from command_line import ran


@pytest.fixture
def doubled(one_strip: Path) -> Path:
    """A dump that lists each of its targets three times under other ids."""
    lines = (one_strip / "targets.csv").read_text().splitlines()
    copies = [f"{line.partition(',')[0]}-{k},{line.partition(',')[2]}" for line in lines[1:] for k in (1, 2)]
    (one_strip / "targets.csv").write_text("\n".join(lines + copies) + "\n")
    return one_strip


def test_targets_listed_under_several_ids_are_counted_once(doubled, finished, tmp_path):
    told = ran("calibrate", doubled, "--out", tmp_path / "out", "--workers", 1, "--no-report").output
    assert "24 targets: 24 given twice" in told, told
    content, once = (
        json.loads((folder / "installation.json").read_text()) for folder in (tmp_path / "out", finished[1])
    )
    assert content["targets"] == once["targets"] == 12
    # The same sightings: what is given twice makes no matrix more certain, nor another one.
    assert np.array_equal(content["covariance_rad2"], once["covariance_rad2"])
    assert np.array_equal(content["R_cs"], once["R_cs"])
