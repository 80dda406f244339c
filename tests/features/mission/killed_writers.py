"""Two writers of one archive, both killed with SIGKILL at moments of their own, again and again."""

import multiprocessing
import os
import random
import signal
import sqlite3
import time
from pathlib import Path

import numpy as np
from drawn_mission import DrawnMission, bare_result, lopsided_pair

from boresight.features.mission.archive import add_mounting, add_results

PAIR = lopsided_pair()
FORK = multiprocessing.get_context("fork")
MOST = 40  # results that writers of a round can add


def write(archive: Path, round: int, told: int) -> None:
    """Add the results of a round; each that was new is written to a pipe once it is added."""
    mission, like = DrawnMission(PAIR, np.random.default_rng(round)), bare_result(PAIR)
    for k in range(round * MOST, (round + 1) * MOST):
        if add_mounting(mission.result(like, f"r{k:06d}", 1e5 * k, np.zeros(3)), archive):
            os.write(told, f"r{k:06d}\n".encode())


def kill_writers(archive: Path, kills: int, seed: int = 0) -> tuple[int, list[str]]:
    """How many results were told to be added, and what is wrong with the archive after so many kills."""
    rng, told = random.Random(seed), []
    add_results([], archive)
    for n in range(-(-kills // 2)):
        out, into = os.pipe()
        pair = [FORK.Process(target=write, args=(archive, n, into)) for _ in "ab"]
        for one in pair:
            one.start()
        os.close(into)
        # at any moment of one of the first additions: of its file, its transaction, or between
        text = b"".join(os.read(out, 8) for _ in range(rng.randint(1, 4)))
        for one in pair:
            time.sleep(rng.uniform(0.0, 0.01))
            os.kill(one.pid, signal.SIGKILL)
            one.join()
        with open(out, "rb") as rest:
            told += (text + rest.read()).decode().split()
    add_results([], archive)  # removes files without a row
    return len(told), list(faults(archive, told))


def faults(archive: Path, told: list[str]):
    """What is lost, doubled or left over."""
    with sqlite3.connect(archive / "archive.gpkg") as database:
        (state,) = database.execute("PRAGMA integrity_check").fetchone()
        names = [row[0] for row in database.execute("SELECT id FROM results")]
        tracks = [row[0] for row in database.execute("SELECT result FROM tracks")]
        totals = database.execute("SELECT results, F FROM totals").fetchall()
    yield from [state] if state != "ok" else []
    yield from [f"{len(lost)} lost"] if (lost := set(told) - set(names)) else []
    yield from ["doubled"] if len(told) != len(set(told)) or sorted(tracks) != sorted(names) else []
    files = {path.name for path in (archive / "information").iterdir()}
    yield from ["files left over"] if files != {f"{name}.parquet" for name in names} else []
    expected = len(names) * PAIR.F[0, 3:, 3:].ravel()
    if [row[0] for row in totals] != [len(names)] or not np.allclose(np.frombuffer(totals[0][1]), expected):
        yield "information is not that of the rows"
