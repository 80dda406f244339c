"""The page of `boresight match`: all candidates with their pictures, and why each was matched or not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from boresight.features.targets.target_matches import StripLine, matches_table
from boresight.gct_match.records import TargetMatch
from boresight.geometry.installation import deviation_from_theta
from boresight.pipeline.files.terrain_files import surface_of
from boresight.pipeline.files.whole_file import write_text
from boresight.pipeline.report.marks import SHAPES, strip_style
from boresight.pipeline.report.observations import Pictures, TargetCard, shown_pictures
from boresight.pipeline.report.page_template import Number, template
from boresight.pipeline.report.unmatched import pictures_at
from boresight.pipeline.stages.match_pictures import MatchPictures
from boresight.pipeline.stages.strip import StripTask, pictures_of_match, pushbroom_of
from boresight.records.ledger import Entry

__all__ = ["write_candidates_page"]

# Candidates with pictures, those that were not matched first: more make the page too large for a browser.
MOST_PICTURES = 400
FORMS = {"sample_px": ".2f", "line_px": ".2f", "correlation": ".3f", "probability_wrong": ".1e"}


def write_candidates_page(
    path: Path, mission: str, tasks: Sequence[StripTask], lines: Sequence[StripLine], table: str
) -> None:
    """Write the HTML page of the candidates of strips, readable without a network. `table` is the file with
    the rows of `matches_table`, from which the page's numbers are.
    """
    outcomes = [(strip, outcome) for strip, line in enumerate(lines) for outcome in line.outcomes]
    rows = matches_table(lines).to_dict("records")
    order = sorted(range(len(rows)), key=lambda n: isinstance(outcomes[n][1], TargetMatch))
    cards: list[TargetCard] = []
    for n in order:
        (strip, outcome), row = outcomes[n], rows[n]
        shape, colour = strip_style(strip)
        matched = isinstance(outcome, TargetMatch)
        numbers = {
            name: Number(exact=row.get(name, np.nan), source=table, key=f"{name}.{n}", form=form)
            for name, form in FORMS.items()
        }
        drawn = _pictures(tasks[strip], lines[strip], outcome) if len(cards) < MOST_PICTURES else None
        cards.append(
            TargetCard(
                link=f"t{n}",
                row=n,
                strip_id=lines[strip].strip_id,
                target_id=row["target_id"],
                ccd=row["ccd"],
                state="matched" if matched else "not matched",
                cause="" if isinstance(outcome, TargetMatch) else outcome.reason.value,
                reason=row["reason"],
                shape=shape,
                colour=colour,
                numbers={name: number for name, number in numbers.items() if np.isfinite(number.exact)},
                pictures=drawn,
                printed=not matched,
            )
        )
    counts = sum(card.state == "matched" for card in cards), len(cards)
    page = template("candidates.html.j2")
    write_text(path, page.render(mission=mission, targets=cards, counts=counts, shapes=SHAPES))


def _pictures(task: StripTask, line: StripLine, outcome: TargetMatch | Entry) -> Pictures | None:
    """Pictures of a match, or of the place where the common rotation, if there is one, expects a target."""
    if isinstance(outcome, TargetMatch):
        shown: MatchPictures | None = pictures_of_match(outcome)
    else:
        shown = _pictures_of_refused(task, line, outcome)
    if shown is None:
        return None
    values = {name: getattr(shown, name) for name in MatchPictures.__dataclass_fields__}
    return shown_pictures(values, lambda name: Number(exact=values[name], source="", key=name, form="+.2f"))


def _pictures_of_refused(task: StripTask, line: StripLine, refused: Entry) -> MatchPictures | None:
    name, ccd = refused.subject.id, refused.subject.ccd
    p_e = next((target.p_e for target in task.targets if target.target_id == name), None)
    if p_e is None:
        return None
    model = pushbroom_of(task)
    if np.isfinite(line.theta).all():
        model = model.with_installation(deviation_from_theta(line.theta) * model.R_cs)
    for seen in task.strip.images.ccds if ccd < 0 else (ccd,):
        xy_px = np.concatenate(model.pixels_from_ground(seen, p_e[None]))
        lines, samples = task.strip.images.shape(seen)
        if ((xy_px > -0.5) & (xy_px < [samples - 0.5, lines - 0.5])).all():
            return pictures_at(task, model, name, seen, xy_px, surface_of(task.terrain))
    return None
