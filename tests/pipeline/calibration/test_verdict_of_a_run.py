"""A dump whose data contradict themselves gives a result that says so, with exit status 3."""

import json
from pathlib import Path

from command_line import ran
from edits import replaced


def test_a_wrong_focal_length_of_the_star_camera_refutes_the_result(one_strip: Path, tmp_path: Path) -> None:
    replaced(one_strip / "star_camera.toml", "focal_length_mm = 100.0", "focal_length_mm = 99.8")
    command = ("calibrate", one_strip, "--out", tmp_path / "out", "--workers", 1, "--no-report")
    told = ran(*command, status=3).stdout
    assert told.splitlines()[0].startswith("verdict                   refuted by "), told
    content = json.loads((tmp_path / "out/installation.json").read_text())
    (check,) = [c for c in content["verdict"]["checks"] if c["kind"] == "residuals of stars"]
    assert content["verdict"]["outcome"] == "refuted" and not check["holds"]
    assert "refuted by" in ran(*command, status=3).output  # nothing to do, and the verdict stands
    ran(*command, "--accept", "refuted")
