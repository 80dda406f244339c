"""A mission over years: terms, steps, predictions of drawn missions, p-values of comparisons, archive, page.

    python benchmarks/years.py --seeds 20 --pairs 200 --kills 20 --results 1000
    python benchmarks/years.py --seeds 100 --pairs 500 --kills 200 --results 10000 --strips 6

Missions are drawn from the information of one calibrated result of fixtures/mini, of three strips a dump;
`--strips`: as many strips a dump. One distortion of the camera is drawn for each mission.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from record import ROOT, arguments_of, exit_status, head, judge_largest, judge_nees, judge_share, verdict
from scipy.stats import chi2, kstest, ncx2

sys.path.insert(0, str(ROOT / "tests" / "features" / "mission"))
from drawn_mission import DrawnMission, Truth
from killed_writers import kill_writers

from boresight.calib.information import InformationPairs
from boresight.features.mission.archive import add_mounting
from boresight.features.mission.mounting_comparison import compare_mountings
from boresight.features.mission.mounting_course import aliases, estimate_course
from boresight.features.mission.saved_mounting import SavedMounting, instant_s, read_saved_mounting
from boresight.geometry.constants import ARCSEC, DAY_S

TO_STRIPS = 3  # of a dump of fixtures/mini


def calibrated(folder: Path) -> SavedMounting:
    """The result of fixtures/mini."""
    command = [sys.executable, "-m", "boresight", "calibrate", str(ROOT / "fixtures" / "mini")]
    subprocess.run([*command, "--out", str(folder)], check=True, capture_output=True)
    return read_saved_mounting(folder)


def years(pair: InformationPairs, seeds: int, one_sided: bool) -> None:
    """Three years of 160 results (of one side of the orbit: 110), with season, orbit term and two steps."""
    name, count = ("one side of the orbit", 110) if one_sided else ("all orbit", 160)
    z, squares, dated, late, said = [], [], 0, 0, 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        truth = Truth(rng, count, one_sided)
        mission = DrawnMission(pair, rng)
        year = 2.0 * np.pi * truth.t_s / (365.25 * DAY_S)
        beta = np.radians(25.0 + 8.0 * np.cos(year)) if one_sided else None
        series = mission.series(truth.t_s, truth.theta(truth.t_s, truth.cos_sin), truth.cos_sin, beta)
        course = estimate_course(series)
        dated += any(abs(step.row - truth.rows[0]) <= 1 for step in course.steps)
        late += any(abs(step.row - truth.rows[1]) <= 15 for step in course.steps)
        said += any("annual and beta angle" in text for text in aliases(series))
        for term, expected in (("annual", truth.annual), ("orbit phase", truth.orbit)):
            if term in course.terms and not one_sided:
                values, covariance = course.of_term(term)
                z += ((values - expected * ARCSEC).ravel() / np.sqrt(np.diag(covariance))).tolist()
        u = rng.uniform(1.2, 1.9) if one_sided else rng.uniform(0.0, 2.0 * np.pi)
        at, t_s = np.array([[np.cos(u), np.sin(u)]]), truth.t_s[-1:] + 30 * DAY_S
        conditions = {"orbit phase": at}
        if one_sided:
            angle = np.radians(25.0 + 8.0 * np.cos(2.0 * np.pi * t_s / (365.25 * DAY_S)))
            conditions["beta angle"] = np.sin(angle)[:, None]
        theta, covariance = course.at(t_s, conditions)
        error = theta[0] - truth.theta(t_s, at)[0]
        squares.append(float(error @ np.linalg.solve(covariance[0], error)))
    judge_share(f"years, {name}: step of 1 arcsec dated within one dump", dated, seeds, least=0.95)
    print(f"step of 0.5 arcsec found within 15 dumps: {late} of {seeds}")
    if z:
        inside = sum(abs(one) <= 2.5 for one in z)
        judge_share(f"years, {name}: coefficients within 2.5 sigma", inside, len(z), least=0.98)
    judge_nees(f"years, {name}: NEES of the prediction a month ahead", squares)
    if one_sided:
        verdict(f"years, {name}: season and beta angle said to alias", "all", said == seeds, seeds)


def rest(pair: InformationPairs, seeds: int) -> None:
    """Steps that are none, at rest and with seasons."""
    for name, annual, orbit in (("at rest", 0.0, 0.0), ("with seasons", 3.0, 5.0)):
        false = 0
        for seed in range(seeds):
            rng = np.random.default_rng(10_000 + seed)
            truth = Truth(rng, 160, annual=annual, orbit=orbit, steps=(0.0, 0.0))
            theta = truth.theta(truth.t_s, truth.cos_sin)
            course = estimate_course(DrawnMission(pair, rng).series(truth.t_s, theta, truth.cos_sin))
            false += len(course.steps)
        judge_share(f"years, {name}: years without a false step", 3 * seeds - false, 3 * seeds, least=0.99)


def comparisons(pair: InformationPairs, like: SavedMounting, count: int) -> None:
    """p-values of results of one camera, and the share of changes of 1 arcsec that is found."""
    p, found = [], 0
    for seed in range(count):
        mission = DrawnMission(pair, np.random.default_rng(seed))
        first = mission.result(like, "a", 0.0, np.zeros(3))
        p.append(compare_mountings(first, mission.result(like, "b", DAY_S, np.zeros(3))).p_value)
        change = np.array([ARCSEC, 0.0, 0.0])
        one = compare_mountings(first, mission.result(like, "b", DAY_S, change))
        found += one.differs
    verdict("compare: KS p of p-values", "> 0.01", (ks := kstest(p, "uniform").pvalue) > 0.01, count)
    power = float(ncx2(3, change @ np.linalg.solve(one.covariance_c, change)).sf(chi2(3).isf(0.01)))
    print(f"KS p {ks:.3f}; 1 arcsec found in {found / count:.3f}, predicted {power:.3f}")
    sigma = (power * (1.0 - power) / count) ** 0.5
    judge_largest(
        "compare: power less predicted, 1 sigma of the sample", abs(found / count - power) / sigma, 3.3
    )


def kills(count: int) -> None:
    """Two writers on one archive, killed at random moments: all that they told is there, once."""
    with tempfile.TemporaryDirectory() as scratch:
        told, wrong = kill_writers(Path(scratch), count)
    print(f"{count} kills: {told} told; {', '.join(wrong)}")
    verdict("archive: lost, doubled or left over after kills", "0", not wrong, count)


def many(pair: InformationPairs, like: SavedMounting, results: int) -> None:
    """CPU time of adding results with their files, and of the page."""
    with tempfile.TemporaryDirectory() as scratch:
        rng, archive = np.random.default_rng(1), Path(scratch) / "archive"
        truth, mission = Truth(rng, results), DrawnMission(pair, rng)
        begin_s, adding = instant_s("2023-01-01"), 0.0
        for k, t_s in enumerate(truth.t_s):
            theta = truth.theta(truth.t_s[k : k + 1], truth.cos_sin[k : k + 1])
            one = mission.result(like, f"{k:016x}", begin_s + t_s, theta, cos_sin=truth.cos_sin[k])
            before = time.process_time()
            read_saved_mounting(like.folder)  # as many files are read as of any result
            add_mounting(one, archive)
            adding += time.process_time() - before
        judge_largest("archive: CPU time of adding a result", 1e3 * adding / results, 20.0, "ms", results)
        command = [
            sys.executable,
            "-m",
            "boresight",
            "trends",
            str(archive),
            "--out",
            scratch,
            "--at",
            "2026-02-01",
        ]
        before_s = os.times()
        with contextlib.suppress(subprocess.CalledProcessError):  # an alarm
            subprocess.run(command, check=True, capture_output=True)
        after_s = os.times()
        cpu_s = after_s.children_user + after_s.children_system
        cpu_s -= before_s.children_user + before_s.children_system
        judge_largest(f"trends of {results} results: CPU time", cpu_s, 3.0, "s")
        size = (Path(scratch) / "trends.html").stat().st_size
        judge_largest(f"trends of {results} results: page", size / 2**20, 2.0, "MiB")


def main() -> int:
    """Print all figures; 1 where a limit is missed."""
    options = (
        ("--seeds", 20, "missions"),
        ("--pairs", 200, "pairs of results"),
        ("--kills", 20, "killed writers"),
    )
    asked = arguments_of(
        __doc__, *options, ("--results", 1000, "results of the archive"), ("--strips", 6, "strips a dump")
    )
    head("A mission over years, drawn from one calibrated result")
    with tempfile.TemporaryDirectory() as scratch:
        like = calibrated(Path(scratch) / "mini")
        scale = asked.strips / TO_STRIPS
        own = like.pair
        pair = InformationPairs(own.names, scale * own.F, scale * own.F_theta, own.R_cs_ref, own.shared)
        years(pair, asked.seeds, one_sided=False)
        years(pair, asked.seeds, one_sided=True)
        rest(pair, asked.seeds)
        comparisons(pair, like, asked.pairs)
        kills(asked.kills)
        many(own, like, asked.results)
    return exit_status()


if __name__ == "__main__":
    sys.exit(main())
