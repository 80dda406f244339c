"""First screen of the report: consistent, or refuted with causes; 1-sigma in metres, too."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from report_page import report_html

from boresight.geometry.constants import ARCSEC
from boresight.pipeline.errors import RawDataError
from boresight.pipeline.report import figures
from boresight.pipeline.report.drawing import Drawing
from boresight.pipeline.report.saved import read_saved
from boresight.pipeline.report.verdict_section import verdict_view


@pytest.fixture(autouse=True)
def no_pictures(monkeypatch):
    """Figures further down the page take most of its time; `test_report` looks at them."""
    blank = lambda figure, name, caption, words, spots=(): Drawing("", caption, words)  # noqa: E731
    monkeypatch.setattr(figures, "drawn", blank)


def check(kind, p_value, holds, *, look_at=("look here",), names=()):
    numbers = {"statistic": 3745.0, "expected": 2130.0, "n": 2130, "limit": 1.25e-5}
    outcome = {
        "p_value": p_value,
        "p_plain": p_value,
        "holds": holds,
        "fails": not holds,
        "is_caution": False,
    }
    words = {"kind": kind, "look_at": list(look_at), "names": [list(group) for group in names]}
    return numbers | outcome | words


def verdict(*checks):
    outcome = "consistent" if all(one["holds"] for one in checks) else "refuted"
    weakest = {"weakest_axis_c": [0.01, -0.02, 0.99], "weakest_sigma_rad": 10.4 * ARCSEC}
    words = {"outcome": outcome, "sentence": outcome, "checks": list(checks), "probability_false_alarm": 1e-4}
    return words | weakest


def first_screen(finished, **changes):
    saved = read_saved(finished[1])
    installation = {k: v for k, v in saved.installation.items() if k != "verdict"} | changes
    html = report_html(replace(saved, installation=installation))
    return re.sub(r"<[^>]*>", "", html[html.index("<header>") : html.index("<nav")]), html


def test_consistent_data_are_called_so_with_the_weakest_axis(finished):
    text, html = first_screen(finished, verdict=verdict(check("residuals of stars", 0.4, True)))
    assert "Consistent." in text and "Refuted" not in text and "Converged" not in html
    assert "refuted with probability 0.0001 at most" in text
    sigma = np.sqrt(np.diag(read_saved(finished[1]).installation["covariance_rad2"])) / ARCSEC
    helps = "The same number of targets, all near the ends of the swath"
    assert f"Weakest axis: Z, {sigma[2]:.4f}″. {helps}" in text
    assert 'class="verdict good"' in html and 'class="verdict bad"' not in html


def test_refuted_data_say_by_what_and_where_to_look_the_least_likely_first(finished):
    failing = (
        check("residuals of targets", 1e-9, False, look_at=("positions and velocities of the satellite",)),
        check("convergence", 0.5, True),
        check("equal coordinates of targets", 0.0, False, names=(("t1", "t1<b>"), ("t2", "t3"))),
    )
    text, html = first_screen(finished, verdict=verdict(*failing))
    assert "Refuted." in text
    assert text.index("equal coordinates of targets") < text.index("residuals of targets")
    assert "Look at: positions and velocities of the satellite." in text
    assert "p 1e-09" in text.replace("\N{MINUS SIGN}", "-") and "3745 where 2130 is expected" in text
    assert "t1 = t1&lt;b&gt;" in html and "<b>" not in html
    assert 'class="verdict good"' not in html and "deviation" not in text


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content.pop("verdict"),
        lambda content: content.update(verdict="good"),
        lambda content: content["verdict"].pop("sentence"),
        lambda content: content["verdict"]["checks"][2].pop("is_caution"),
    ],
)
def test_a_result_whose_verdict_is_damaged_is_refused_with_its_file(result, damage):
    content = json.loads((result / "installation.json").read_text())
    damage(content)
    (result / "installation.json").write_text(json.dumps(content))
    with pytest.raises(RawDataError, match=r"installation\.json: verdict: found .*calibrate again"):
        read_saved(result)


def test_the_saved_verdict_of_a_good_mission_is_shown(finished):
    saved = read_saved(finished[1])
    view = verdict_view(saved.installation)
    assert view.outcome == "consistent" and len(view.checks) == 8 and not view.failed
    html = report_html(saved)
    assert "Consistent: " in html and 'id="checks"' in html
    assert all(check["kind"] in html for check in saved.installation["verdict"]["checks"])


def test_one_sigma_is_given_in_metres_on_the_ground(finished):
    saved = read_saved(finished[1])
    text, _ = first_screen(finished, verdict=saved.installation["verdict"])
    ground = saved.context["ground"]
    sigma = np.sqrt(np.diag(saved.installation["covariance_rad2"]))
    levers = ground["range_m"] * np.array([1.0, 1.0, ground["edge_tan"]])
    for words, values in (("1σ, ″", sigma / ARCSEC), ("1σ, m on the ground", sigma * levers)):
        form = ".4f" if "″" in words else ".2f"
        assert words + "".join(format(value, form) for value in values) in text.replace("\n", "")
    assert 4e5 < ground["range_m"] < 8e5  # the mini scenario flies at 530 km


def test_hostile_names_stay_text(finished):
    name = "\x1b[31m {{ 7 * 7 }} </style><script>x</script> a\nb\u2028c"
    saved = read_saved(finished[1])
    html = report_html(replace(saved, context=saved.context | {"mission": name}))
    assert html.count("<script>") == 1 and "49" not in html[html.index("<h1>") : html.index("</h1>")]
