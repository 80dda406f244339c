"""No name means two things: each public function, class and file of the package is defined once."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scripts"))

import public_names as names  # noqa: E402


def test_public_names_and_files_are_defined_once() -> None:
    assert names.repeated(names.names_by_place()) == {}
    assert names.repeated(names.files_by_name()) == {}


def test_a_name_in_two_modules_is_listed(tmp_path: Path, monkeypatch) -> None:
    for room in names.ROOMS:
        (tmp_path / room).mkdir()
    (tmp_path / "calib" / "one.py").write_text("def solve(): ...\ndef _own(): ...\n")
    (tmp_path / "star_id" / "one.py").write_text("class solve: ...\ndef _own(): ...\n")
    (tmp_path / "boresight" / "calib").symlink_to("../calib")
    monkeypatch.setattr(names, "ROOT", tmp_path)
    assert names.repeated(names.names_by_place()) == {"solve": ["calib/one.py", "star_id/one.py"]}
    assert names.repeated(names.files_by_name()) == {"one.py": ["calib/one.py", "star_id/one.py"]}
