"""`import boresight`: its names, types, documentation and results."""

import ast
import dataclasses
import doctest
import importlib
import inspect
import io
import json
import re
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace as Of
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation
from wrong_vectors import drawn_vectors

import boresight as bs
from boresight import missions
from boresight.display import Result
from boresight.features.planning import campaign_plan
from boresight.geometry.constants import ARCSEC

ROOT = Path(__file__).parents[2]
MINI = ROOT / "fixtures" / "mini"
EXPOSURE = MINI / "exposures" / "e0001.png"
FUNCTIONS = [name for name in bs.__all__ if inspect.isfunction(getattr(bs, name))]
RESULTS = [
    name
    for name in bs.__all__
    if inspect.isclass(getattr(bs, name)) and issubclass(getattr(bs, name), Result)
]


@pytest.fixture(scope="module")
def dump(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first strip of `fixtures/mini`, with its exposures, targets and truth."""
    root = Path(shutil.copytree(MINI, tmp_path_factory.mktemp("one") / "mini"))
    for name, rows in (("strips.csv", 4), ("exposures.csv", 14), ("targets.csv", 12)):
        lines = (root / name).read_text().splitlines(keepends=True)
        (root / name).write_text("".join(lines[: rows + 1]))
    return root


@pytest.fixture(scope="module")
def estimate(dump: Path) -> bs.Calibration:
    return bs.calibrate(dump)


@pytest.fixture(scope="module")
def ground() -> np.ndarray:
    return 500.0 + 400.0 * gaussian_filter(np.random.default_rng(5).normal(size=(220, 240)), 1.5)


def test_type_checkers_and_run_time_see_the_same_names() -> None:
    tree = ast.parse((ROOT / "boresight" / "__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    imported = {
        alias.name: node.module
        for node in block.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    assert sorted(imported) == sorted(bs.__all__)
    for name, module in imported.items():
        assert getattr(bs, name) is getattr(importlib.import_module(str(module)), name)
        assert name in dir(bs)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        bs.nothing  # noqa: B018


# Prints at its end which modules a program has loaded.
LISTED = """
import atexit, sys
atexit.register(lambda: print(*(name for name in sys.modules if sys.modules[name]), file=sys.stderr))
"""
PROGRAM = f"{LISTED}\nimport boresight.__main__; boresight.__main__.main()"
LIBRARIES = f"{LISTED}\nimport numpy, scipy.linalg, pandas"
# What draws, what fills templates of pages, and libraries of extras that others load where installed.
OPTIONAL = {"matplotlib", "skimage", "jinja2", "boto3", "dask", "distributed", "fsspec", "spiceypy"}
OPTIONAL |= {"numpy.f2py", "numpy.testing"}


def loaded(code: str, *words: str) -> tuple[float, set[str]]:
    """CPU time of a program from its start to its end, s, and the modules that it has loaded."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, "-c", code, *words]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    took_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return took_s, set(told.splitlines()[-1].split())


@pytest.fixture(scope="module")
def libraries_s() -> list[float]:
    """CPU times of loading the libraries that most of the program uses, s; tests add theirs."""
    return [loaded(LIBRARIES)[0]]


@pytest.mark.timed
@pytest.mark.parametrize(
    "words, limit, unneeded",
    [  # limit of CPU time as a ratio to that of the libraries; measured were 0.13, 0.48, 0.27, 0.94 and 0.65
        (["--help"], 0.17, {"numpy", "pydantic", "rich", "pandas", "importlib.metadata"}),
        (["identify", "--help"], 0.65, {"pydantic", "pandas", "pyarrow", "rasterio", "rich"}),
        (["status", "--help"], 0.4, {"pandas", "rich"}),
        (["geolocate", "--help"], 1.3, {"pandas", "rich"}),
        (["identify", str(EXPOSURE), "--fov", "18.6"], 0.75, {"pydantic", "pandas", "pyarrow", "rasterio"}),
    ],
)
def test_a_command_loads_what_it_needs(
    words: list[str], limit: float, unneeded: set[str], libraries_s: list[float]
) -> None:
    spent_s: list[float] = []
    while len(spent_s) < 8 and min(spent_s, default=np.inf) > limit * min(libraries_s):
        if spent_s:  # a first run compiles
            libraries_s.append(loaded(LIBRARIES)[0])
        took_s, modules = loaded(PROGRAM, *words)
        spent_s.append(took_s)
        assert "typer" in modules and not modules & (unneeded | OPTIONAL)
    assert min(spent_s) <= limit * min(libraries_s)


WITH_EXAMPLES = sorted(
    {getattr(bs, name).__module__ for name in FUNCTIONS if ">>>" in getattr(bs, name).__doc__}
)


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_of_the_docstrings_run(module: str, demo: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of `calibrate` itself calibrate the example; the others begin with its result."""
    monkeypatch.chdir(ROOT)
    if module != bs.calibrate.__module__:
        monkeypatch.setattr(bs, "calibrate", lambda dump: bs.read_result(demo / "demo-result"))
    monkeypatch.setattr(campaign_plan, "DRAWS", 1)  # how often a strip is drawn is not what is shown
    monkeypatch.setattr(campaign_plan, "PLAN_DRAWS", 10)
    done = doctest.testmod(importlib.import_module(module))
    assert done.failed == 0
    assert done.attempted >= 2


def test_most_functions_show_an_example() -> None:
    assert len(WITH_EXAMPLES) >= 5
    finder = doctest.DocTestFinder()
    lines = [
        len(test.examples) for name in WITH_EXAMPLES for test in finder.find(importlib.import_module(name))
    ]
    assert sum(lines) > 18  # as when three modules held them, more than five each


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_documents_parameters_result_and_errors(name: str) -> None:
    function = getattr(bs, name)
    text = inspect.getdoc(function) or ""
    for section in ("Parameters", "Returns", "Raises"):
        assert f"{section}\n{'-' * len(section)}\n" in text, section
    head = text.split("Parameters\n---")[1].split("Returns\n---")[0]
    documented = {one for line in re.findall(r"(?m)^([a-z_A-Z0-9, ]+) : ", head) for one in line.split(", ")}
    assert documented == set(inspect.signature(function).parameters)


@pytest.mark.parametrize("name", RESULTS)
def test_help_of_every_result_shows_shapes_units_and_meaning(name: str) -> None:
    text = inspect.getdoc(getattr(bs, name)) or ""
    fields = [line for line in text.split("Attributes")[1].splitlines() if " : " in line]
    for line in fields:
        field, kind = line.strip().split(" : ")
        assert not kind.startswith("Floats"), f"{name}.{field} states no shape"
        assert f"{field} : {kind}\n    " in text, f"{name}.{field} states no meaning"


def test_every_result_shows_itself(estimate: bs.Calibration, ground: np.ndarray) -> None:
    stars = bs.find_stars(EXPOSURE)
    camera = bs.open_dump(MINI).star_camera
    solution = bs.identify(stars, camera=camera)
    match = bs.match_template(ground[60:124, 50:114], ground, start_px=(84, 88))
    lens = bs.calibrate_star_camera([MINI / "exposures" / f"e{n:04d}.png" for n in (1, 15)], camera=camera)
    vectors = bs.calibrate_vectors(*drawn_vectors(np.random.default_rng(1), frames=4))
    for result in (estimate, stars, solution, match, lens, vectors):
        assert isinstance(result, Result)
        assert 3 <= len(repr(result).splitlines()) <= 25
        assert "not used: " in repr(result) or result is match or result is lens
        assert isinstance(result.table(), pd.DataFrame)
        assert "<table" in result._repr_html_()
        axes = result.plot()
        assert isinstance(axes, Axes)
        assert result.plot(axes) is axes
    checks = pd.concat([estimate.checks, vectors.checks])
    assert checks[["p_plain", "p_value"]].stack().dropna().between(0.0, 1.0).all() and len(checks) > 9
    shown = {"stars": np.vstack([stars.xy_px, stars.misshapen_px]), "lens": lens.fit.xy_px}
    residuals = ["residual_x_arcsec", "residual_y_arcsec"]
    shown |= {"estimate": estimate.targets[residuals], "vectors": vectors.targets[residuals]}
    for name, result in (("stars", stars), ("lens", lens), ("estimate", estimate), ("vectors", vectors)):
        assert sorted(map(tuple, drawn(result.plot()))) == sorted(map(tuple, np.asarray(shown[name]))), name
    arrows = lens.plot(magnified=7.0).collections[-1]
    drawn_px = np.column_stack([arrows.U, arrows.V]) / arrows.scale
    np.testing.assert_allclose(drawn_px, 7.0 * lens.fit.residual_px)
    picture = match.plot().images[0].get_array()
    np.testing.assert_array_equal(np.hsplit(picture, 2)[0], match.found)
    np.testing.assert_allclose(np.hsplit(picture, 2)[1] - match.residual, np.median(match.found))


def test_tables_of_a_matrix_and_of_several_have_their_numbers(estimate: bs.Calibration) -> None:
    L = np.tril(np.random.default_rng(3).normal(size=(6, 6)) + 3.0 * np.eye(6)) * ARCSEC
    both = dataclasses.replace(
        estimate,
        cameras=("left", "right"),
        R_cs=Rotation.concatenate([estimate.R_cs, estimate.R_cs.inv()]),
        theta=ARCSEC * np.array([3.0, -1.0, 4.0, -1.5, 9.0, 2.6]),
        cov_theta=L @ L.T,
    )
    left, right = both.of_camera("left"), both.of_camera("right")
    for n, (one, R_cs) in enumerate([(left, estimate.R_cs), (right, estimate.R_cs.inv())]):
        assert (one.R_cs * R_cs.inv()).magnitude() < 1e-14
        np.testing.assert_array_equal(one.theta, both.theta[3 * n : 3 * n + 3])
        np.testing.assert_array_equal(one.cov_theta, both.cov_theta[3 * n : 3 * n + 3, 3 * n : 3 * n + 3])
    for result in (estimate, left, right, both):
        table = result.table()
        of = [f"{camera}_{axis}".lstrip("_") for camera in result.cameras for axis in "xyz"]
        assert table["axis"].tolist() == list("XYZ") * (len(of) // 3)
        stated = [table.pop(f"{name}_arcsec").to_numpy() * ARCSEC for name in ("theta", "sigma")]
        np.testing.assert_allclose(stated[0], result.theta, rtol=1e-12)
        found = table[[f"correlation_{name}" for name in of]].to_numpy() * np.outer(stated[1], stated[1])
        np.testing.assert_allclose(found, result.cov_theta, rtol=1e-12, atol=1e-20)
        (shown,) = pd.read_html(io.StringIO(result._repr_html_()), index_col=0)
        printed = [shown.loc[[f"{name}, arcsec"]].to_numpy() for name in ("theta", "1 sigma")]
        rows = np.reshape([result.theta, stated[1]], (2, -1, 3)) / ARCSEC  # X, Y, Z of a camera
        np.testing.assert_allclose(printed, rows, rtol=0.0, atol=5.1e-5)  # four digits are printed


def drawn(axes: Axes) -> np.ndarray:
    """Places (N, 2) of all markers, circles and feet of arrows of a plot."""
    parts = [line.get_xydata() for line in axes.lines] + [one.get_offsets() for one in axes.collections]
    return np.vstack(parts)


def test_identified_image_points_where_the_dump_says(estimate: bs.Calibration) -> None:
    solution = bs.identify(EXPOSURE, camera=bs.open_dump(MINI).star_camera)
    assert solution
    assert estimate.saved is not None
    R_si = estimate.saved.R_si[int(np.argmin(estimate.saved.t_exposures_s))]  # e0001 is the first
    # without a time the annual and orbital aberration remain: 30 arcsec at most
    assert (solution.R_si * R_si.inv()).magnitude() * 206265 < 30.0
    assert solution.fov_deg == pytest.approx(np.degrees(solution.camera.fov_x_rad))
    size = np.array([solution.camera.width_px, solution.camera.height_px])
    z = solution.camera.directions_from_pixels((size[None] - 1.0) / 2.0)[0]  # of the image's middle
    x = np.cross(z, [0.0, 1.0, 0.0]) / np.hypot(z[0], z[2])
    of_axes = [206264.806 * np.sqrt(axis @ solution.cov_s @ axis) for axis in (x, np.cross(z, x), z)]
    assert solution.sigma_arcsec[0] == pytest.approx(np.hypot(*of_axes[:2]) / np.sqrt(2.0), rel=1e-6)
    assert solution.sigma_arcsec[1] == pytest.approx(of_axes[2], rel=1e-6)


def test_no_answer_is_false_and_says_why(ground: np.ndarray) -> None:
    image = np.random.default_rng(3).normal(100.0, 5.0, (200, 200)).astype(np.float32)
    unknown = bs.identify(image, fov_deg=20)
    assert isinstance(unknown, bs.NotIdentified)
    assert not unknown
    assert "0 stars found" in unknown.reason
    elsewhere = bs.match_template(ground[60:124, 50:114], ground[::-1], start_px=(84, 88))
    assert isinstance(elsewhere, bs.NotMatched)
    assert not elsewhere
    assert repr(elsewhere) == f"not matched: {elsewhere.sentence}"
    assert not bs.calibrate_star_camera([image])


def test_a_template_is_found_in_transposed_arrays_at_the_transposed_place(ground: np.ndarray) -> None:
    wide, picture = ground[60:100, 30:130], ground[40:120, 10:190] + 3.0  # wider than the picture is high
    one, other = (
        bs.match_template(small, large, start_px=at)
        for small, large, at in ((wide, picture, (71.0, 38.0)), (wide.T, picture.T, (38.0, 71.0)))
    )
    assert one and other
    # px: the same grey values, added up in another order
    assert one.xy_px == pytest.approx([69.5, 39.5], abs=1e-3)
    assert other.xy_px[::-1] == pytest.approx(one.xy_px, abs=1e-3)
    for small, large in ((wide, ground[:80, :99]), (wide.T, ground[:99, :80])):
        with pytest.raises(ValueError, match=r"picture: found .*, expected at least"):
            bs.match_template(small, large, start_px=(40, 40))


def test_dumps_are_calibrated_jointly_with_the_trend_of_their_matrices(monkeypatch) -> None:
    requests = []

    def noted(folder: Path, dumps: object, request: Any) -> None:
        requests.append(request)
        raise bs.DataNotSufficientError("noted")

    monkeypatch.setattr(missions, "run_dumps", noted)
    monkeypatch.setattr(missions, "open_dumps", lambda *_, **__: [Of(dump=Of(pixels=1.0))] * 2)
    with pytest.raises(bs.DataNotSufficientError, match="noted"):
        bs.calibrate([MINI, MINI])
    assert [one.__name__ for one in requests[0].after_joint] == ["trend_of_dumps"]


def test_callers_mistakes_are_named(estimate: bs.Calibration, tmp_path: Path) -> None:
    camera = bs.open_dump(MINI).star_camera
    with pytest.raises(ValueError, match="a joint result without a folder"):
        dataclasses.replace(estimate, _run=None).report(tmp_path / "page.html")
    with pytest.raises(ValueError, match="exclude one another"):
        bs.identify(EXPOSURE, camera=camera, fov_deg=20)
    with pytest.raises(ValueError, match=r"between 0\.5 and 175"):
        bs.identify(EXPOSURE, fov_deg=176)
    with pytest.raises(ValueError, match="one size"):
        bs.calibrate_star_camera([np.ones((64, 64)), np.ones((64, 65))])
    with pytest.raises(ValueError, match="strips: found 'nine', expected ids among"):
        bs.match_targets(MINI, strips=["nine"])
    with pytest.raises(bs.RawDataError, match=r"dump\.toml"):
        bs.calibrate(ROOT / "docs")
    for n in (2, 3):
        with pytest.raises(bs.RawDataError, match="named twice"):
            bs.calibrate([MINI] * n)


def test_a_dump_gives_the_same_matrix_in_memory_and_in_a_folder(
    estimate: bs.Calibration, dump: Path, tmp_path: Path
) -> None:
    in_folder = bs.calibrate(dump, out=tmp_path / "result")
    again = bs.read_result(tmp_path / "result")
    for other in (in_folder, again):
        assert np.array_equal(estimate.R_cs.as_quat(), other.R_cs.as_quat())
        assert np.array_equal(estimate.cov_theta, other.cov_theta)
        pd.testing.assert_frame_equal(estimate.targets, other.targets)
    written = json.loads((tmp_path / "result" / "installation.json").read_text())
    assert np.array_equal(written["covariance_rad2"], estimate.cov_theta)
    validation = bs.validate(estimate, dump)
    assert bs.validate(again, dump).nees == validation.nees < 11.3  # chi-square, 3 degrees of freedom, 99 %
    table = validation.table()
    np.testing.assert_array_equal(drawn(validation.plot()), table[["across_m", "along_m"]])
    assert len(table) and not np.allclose(table[["across_m", "along_m"]], table[["along_m", "across_m"]])
    for result in (estimate, in_folder, tmp_path / "result"):
        with pytest.raises(bs.RawDataError, match="another dump"):
            bs.validate(result, MINI)
    page = estimate.report(tmp_path / "memory.html")
    assert "<html" in page.read_text()[:500]
    ground = bs.geolocate(tmp_path / "result", "s01", 1, sample=[10.0, 500.0], line=1000.0)
    assert np.isfinite(ground.to_numpy()).all()
    assert (ground["sigma_across_m"] < 30.0).all()  # m: 10 arcsec from 530 km


def test_a_simulated_dump_opens(tmp_path: Path) -> None:
    changes = ["strips.count=1", "targets.per_strip=1"]
    with pytest.raises(ValueError, match="expected a new or empty folder"):
        bs.simulate("mini", MINI, changes=changes)
    with pytest.raises(ValueError, match="scenario 'nowhere'"):
        bs.simulate("nowhere", tmp_path / "dump")


# The ignored line is an error of its own, "unused", where a misspelt name passes.
USER_SCRIPT = """
import boresight as bs
from boresight import mispelt  # type: ignore[attr-defined]
import numpy as np

image = np.zeros((64, 64), dtype=np.uint16)
stars = bs.find_stars(image)
reveal_type(stars)
reveal_type(stars.xy_px)
reveal_type(stars.table())
reveal_type(stars.plot())
solution = bs.identify(stars, fov_deg=20)
reveal_type(solution)
if solution:
    reveal_type(solution)
    reveal_type(solution.ra_deg)
    reveal_type(solution.sigma_arcsec)
    reveal_type(solution.R_si)
    reveal_type(solution.camera.focal_m)
else:
    reveal_type(solution)
    reveal_type(solution.reason)
camera = bs.calibrate_star_camera([image, "image.png"], fov_deg=20)
if camera:
    reveal_type(camera.camera)
match = bs.match_template(image, image, start_px=(3, 4))
if match:
    reveal_type(match.xy_px)
    reveal_type(match.correlation)
else:
    reveal_type(match.sentence)
matches = bs.match_targets("dump")
reveal_type(matches.table())
estimate = bs.calibrate("dump", workers=2)
reveal_type(estimate)
reveal_type(estimate.R_cs)
reveal_type(estimate.cov_theta)
reveal_type(estimate.chi2)
reveal_type(estimate.verdict)
reveal_type(estimate.targets)
reveal_type(estimate.report("report.html"))
vectors = bs.calibrate_vectors(np.eye(3), np.eye(3), 1e-5, np.eye(3), np.eye(3), 1e-6, estimate.R_cs)
reveal_type(vectors.sigma_arcsec)
reveal_type(vectors.checks)
reveal_type(estimate.residuals("stars"))
reveal_type(estimate.export("spice", "out"))
reveal_type(estimate.geolocate("s01", 0, 1.0, 2.0))
reveal_type(bs.read_result("result"))
validation = bs.validate(estimate, "dump")
reveal_type(validation)
reveal_type(validation.nees)
reveal_type(bs.geolocate("result", "s01", 0, sample=1.0, line=2.0))
reveal_type(bs.open_dump("dump").star_camera)
reveal_type(bs.simulate("mini", "out"))
reveal_type(bs.forecast("plan.toml").table)
reveal_type(bs.forecast("plan.toml").strips_needed)
bs.mispelt
"""


NOT_IN_SIGNATURES = (
    *("annotated_types", "astropy", "click", "cv2", "dask", "distributed", "jinja2", "optype", "packaging"),
    *("PIL", "platformdirs", "pydantic", "pydantic_core", "pyparsing", "pyproj", "rasterio", "rich"),
    *("scipy.fft", "scipy.integrate", "scipy.interpolate", "scipy.linalg", "scipy.ndimage", "scipy.optimize"),
    *("scipy.signal", "scipy.sparse", "scipy.special", "scipy.stats", "skimage", "tomlkit", "tornado"),
    "typer",
)


def test_a_users_strict_script_sees_no_any(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(USER_SCRIPT)
    # As an installed package is seen: by its signatures. Bodies are checked by `make types`.
    # Libraries that no signature names are not followed: a type of theirs would be an `Any`.
    (tmp_path / "mypy.ini").write_text(
        "[mypy]\n[mypy-boresight.*]\nignore_errors = True\n"
        f"[mypy-{','.join(f'{name}.*' for name in NOT_IN_SIGNATURES)}]\n"
        "follow_imports = skip\nfollow_imports_for_stubs = True\n"
    )
    cache = ROOT / ".mypy_cache" / "users_script"
    strict = ["--strict", f"--config-file={tmp_path / 'mypy.ini'}", f"--cache-dir={cache}"]
    command = [sys.executable, "-m", "mypy", *strict, str(script)]
    environment = {"PATH": "/usr/bin:/bin", "MYPYPATH": str(ROOT), "HOME": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, env=environment)
    lines = [line for line in done.stdout.splitlines() if line.startswith("script.py")]
    revealed = [line.split("Revealed type is ")[1] for line in lines if "Revealed type is" in line]
    assert len(revealed) == USER_SCRIPT.count("reveal_type")
    errors = [line for line in lines if ": error:" in line]
    assert len(errors) == 1 and 'no attribute "mispelt"' in errors[0]
    shapes_aside = [text.replace("tuple[Any, ...]", "tuple[int, ...]") for text in revealed]  # NumPy's own
    assert not [text for text in shapes_aside if re.search(r"\bAny\b", text)]


PAGES = "pipeline.report.page", "features.sky_images.identify_page", "features.targets.check_page"


@pytest.mark.parametrize(
    ("modules", "needed", "unneeded"),
    [
        ((), set(), {"numpy", "typer"}),
        ((*PAGES, "features.vectors.api"), {"jinja2"}, {"matplotlib", "skimage", "geopandas"}),
        (
            ("features.sky_images.identify_images",),  # names stars
            set(),
            {"pandas", "pydantic", "scipy.interpolate", "scipy.optimize", "scipy.signal", "scipy.stats"},
        ),
    ],
)
def test_a_module_loads_no_library_that_it_does_not_need(
    modules: tuple[str, ...], needed: set[str], unneeded: set[str]
) -> None:
    code = f"import sys, boresight{''.join(f', boresight.{name}' for name in modules)}; print(*sys.modules)"
    loaded = set(subprocess.check_output([sys.executable, "-c", code], text=True).split())
    assert needed <= loaded and not unneeded & loaded
