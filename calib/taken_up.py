"""What the matrices take up of the errors of a pass.

The targets of a pass share an error of its attitudes, of the satellite's position and of the rows' clock, and
what all of them show alike turns the matrix. Pixels of the same pass have the same error, so that on the
ground the two cancel as far as the matrix has taken it up. With the response G of the estimate to a constant
error of one pass,

    theta estimated - theta = G e + what other observations add,

the covariance of theta with e follows from that of e (`pipeline.results.place_errors`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from boresight.calib.heads import alignment_names
from boresight.calib.joint_solution import Problem, Step
from boresight.calib.strips import PreparedStrip, matrix_of_each
from boresight.geometry.attitude_estimate import cross_matrices
from boresight.records.record import Floats

__all__ = ["taken_up"]


def taken_up(
    problem: Problem, step: Step, prepared: Sequence[PreparedStrip], heads: Sequence[str]
) -> dict[str, Floats]:
    """Change (3 H, 7) of the matrices of the reference head and of other `heads`, rad, axes of c, of each
    strip's camera, by errors of its pass, true less assumed: a rotation of the attitudes about the axes of s,
    rad, the position along the track, to the right and down, m, and the instants of the rows, s.
    """
    found: dict[str, Floats] = {}
    of_all, members, last = step.solution.covariance_all, iter(problem.members), 0
    for group, line, part in zip(problem.groups, step.about.strips, step.reduced):
        S, J = group.inside.shape
        passes = [_until(members, prepared, J) for _ in range(S)]
        first, last = last, last + S * J
        C = matrix_of_each(step.about.R_cs, group.which)
        change = C @ np.array([np.concatenate([_by_errors(prepared[p]) for p in unit]) for unit in passes])
        weight = step.weight[first:last].reshape(S, J)
        rows = weight[:, :, None, None] * line.across @ change
        number = np.array([np.repeat(np.arange(len(u)), [len(prepared[p].strip) for p in u]) for u in passes])
        for n in range(int(number.max(initial=0)) + 1):
            own = (rows * (number == n)[:, :, None, None]).reshape(S, 2 * J, -1)
            right = line.onto(own) - np.swapaxes(part.back[:, :, :-1], 1, 2) @ (
                np.swapaxes(line.X_q, 1, 2) @ own
            )
            for unit, x in zip(passes, of_all @ right):
                if n < len(unit):
                    found.update(_of_strips(problem, step, prepared[unit[n]], heads, x))
    return found


def _until(members: Iterator[int], prepared: Sequence[PreparedStrip], targets: int) -> list[int]:
    """The next of the members that have so many targets together."""
    found: list[int] = []
    while sum(len(prepared[p].strip) for p in found) < targets:
        found.append(next(members))
    return found


def _by_errors(one: PreparedStrip) -> Floats:
    """Change (J, 3, 7) of v_s by the errors of a pass."""
    return np.concatenate([-cross_matrices(one.v_s), one.move_s, one.late_s[:, :, None]], axis=2)


def _of_strips(
    problem: Problem, step: Step, one: PreparedStrip, heads: Sequence[str], x: Floats
) -> Iterator[tuple[str, Floats]]:
    """The strips of a pass, and the change of the matrices of their cameras, from that of all unknowns."""
    names = problem.shared.names
    first = len(step.solution.theta)
    for strip, row in zip(*np.unique(one.strip, return_index=True)):
        n = int(one.camera[row])
        theta, C = x[3 * n : 3 * n + 3], matrix_of_each(step.about.R_cs, np.array(n))
        alphas = [x[[first + names.index(name) for name in alignment_names(head)]] for head in heads]
        yield str(strip), np.concatenate([theta, *(theta - C @ alpha for alpha in alphas)])
