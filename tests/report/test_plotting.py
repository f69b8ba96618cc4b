"""Figures: themes, legibility at dock width, what is drawn; and the report page."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure
from tests.report_example import candidate, report

from napari_mufasa.compare.distributions import Distribution
from napari_mufasa.report import figures
from napari_mufasa.report import html as html_report
from napari_mufasa.report import plots as plotting
from napari_mufasa.report import words as wording

RNG = np.random.default_rng(0)
TRACES = RNG.normal(20, 5, (6, 100))
MOVIE = RNG.poisson(5, (10, 16, 20))
TABLE = pd.DataFrame({"y_px": [3.0, 8.0], "x_px": [4.0, 15.0], "kept": [True, False]})
SHOWN = Distribution(
    "counts", np.arange(5.0), "signal per frame (photoelectrons)", "density",
    {"measured": np.ones(5), "mufasa": np.arange(5.0), "poisson": np.full(5, np.nan)},
)  # fmt: skip
W1 = {"mufasa": 0.3, "poisson": 2.1, "sofi": None, "floor": 0.25, "unit": "photoelectrons per frame"}

ON_AXES = {
    "staircase": lambda ax: plotting.staircase(ax, report()),
    "staircase_of_nothing": lambda ax: plotting.staircase(ax, report("adequate")),
    "evidence": lambda ax: plotting.evidence(ax, report().ranking, threshold=12),
    "evidence_of_nothing": lambda ax: plotting.evidence(ax, []),
    "z_scores": lambda ax: plotting.z_scores(ax, report().observables),
    "curve": lambda ax: plotting.curve(ax, report().curves[0]),
    "trace": lambda ax: plotting.trace(ax, TRACES[0], "Molecule 0", 0.02),
    "distribution": lambda ax: plotting.distribution(ax, SHOWN, W1),
    "w1_bars": lambda ax: plotting.w1_bars(ax, W1),
    "molecules": lambda ax: plotting.molecules(ax, MOVIE[0], TABLE),
}
ON_FIGURES = {
    "curves": lambda f: plotting.curves(f, report().curves),
    "strengths": lambda f: plotting.strengths(f, report().ranking[0]),
    "contact_sheet": lambda f: plotting.contact_sheet(f, TRACES),
    "side_by_side": lambda f: plotting.side_by_side(f, TRACES, TRACES[:, :40]),
    "contact_sheet_of_nothing": lambda f: plotting.contact_sheet(f, TRACES[:0]),
    "distributions": lambda f: plotting.distributions(f, [SHOWN, SHOWN]),
    "montage": lambda f: plotting.montage(f, MOVIE, title="Movie"),
}


def draw(name: str, theme: str, width_in: float):
    with plotting.style(theme):
        made = plotting.figure(width_in, 3.0)
        if name in ON_AXES:
            ON_AXES[name](made.add_subplot())
        else:
            ON_FIGURES[name](made)
        return made, plotting.image_bytes(made, dpi=100)


def pixels(png: bytes) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=float)


@pytest.mark.parametrize("theme", ["dark", "light"])
@pytest.mark.parametrize("name", [*ON_AXES, *ON_FIGURES])
def test_every_figure_is_on_the_themes_ground_and_has_contrast(name, theme):
    _, png = draw(name, theme, 6.4)
    image = pixels(png)
    ground = np.array([int(plotting.PALETTES[theme].background[i : i + 2], 16) for i in (1, 3, 5)])
    np.testing.assert_array_equal(image[-1, 0], ground)
    assert np.abs(image.mean(axis=2) - ground.mean()).max() > 80  # ink that can be read


@pytest.mark.parametrize("name", [*ON_AXES, *ON_FIGURES])
def test_at_dock_width_no_text_is_cut_off(name):
    with plotting.style("dark"):
        made = plotting.figure(3.5, 3.4)
        if name in ON_AXES:
            ON_AXES[name](made.add_subplot())
        else:
            ON_FIGURES[name](made)
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.text import Text

        canvas = FigureCanvasAgg(made)
        canvas.draw()
        renderer = canvas.get_renderer()
        for text in made.findobj(Text):
            if text.get_visible() and text.get_text().strip() and text.axes is None:
                continue
            if not (text.get_visible() and text.get_text().strip()):
                continue
            if not _is_drawn(text):
                continue
            box = text.get_window_extent(renderer)
            assert box.x0 >= -2 and box.x1 <= made.bbox.width + 2, text.get_text()


def _is_drawn(text) -> bool:
    """Tick labels outside the limits exist without being drawn; hidden axes draw nothing."""
    ax = text.axes
    if not ax.axison and text not in ax.texts:
        return False
    ticks = [*ax.xaxis.get_major_ticks(), *ax.xaxis.get_minor_ticks()]
    ticks += [*ax.yaxis.get_major_ticks(), *ax.yaxis.get_minor_ticks()]
    if any(text in (tick.label1, tick.label2) for tick in ticks):
        shown = [*ax.xaxis._update_ticks(), *ax.yaxis._update_ticks()]
        return any(text in (tick.label1, tick.label2) for tick in shown)
    return True


def test_style_is_left_behind():
    import matplotlib

    before = matplotlib.rcParams["figure.facecolor"]
    with plotting.style("dark"):
        assert matplotlib.rcParams["figure.facecolor"] == plotting.PALETTES["dark"].background
    assert matplotlib.rcParams["figure.facecolor"] == before


def test_staircase_shows_errors_floor_and_the_effects_that_lost():
    made, _ = draw("staircase", "light", 6.4)
    ax = made.axes[0]
    points = {tuple(np.round(line.get_ydata(), 2)) for line in ax.lines}
    assert (2.93, 1.04) in points and (0.98, 0.98) in points
    assert (1.31, 2.4, 2.7) in points  # not the effect that was chosen, not one without an error


def test_staircase_tells_what_would_come_on_top_from_what_came_instead():
    """After an effect was added, the ranking is that of the next one: its errors belong to the last step."""
    first = report()
    asked_again = replace(first, ranking=[c for c in first.ranking if c.effect not in first.chosen])
    for which, told in ((first, "instead: "), (asked_again, "on top of it: ")):
        with plotting.style("light"):
            ax = plotting.figure(9, 4).add_subplot()
            plotting.staircase(ax, which)
        assert any(label.startswith(told) for label in ax.get_legend_handles_labels()[1])


def test_no_word_is_broken_under_a_staircase_of_many_steps():
    kinds = ["illumination_profile", "photobleaching", "brightness_heterogeneity", "background_decay", "binding"]
    history = [*report().history, *({"added": kind, "error": 1.0} for kind in kinds)]
    with plotting.style("light"):
        ax = plotting.figure(6.4, 3.2).add_subplot()
        plotting.staircase(ax, replace(report(), history=history))
    shown = [label.get_text() for label in ax.get_xticklabels()]
    words = {word for name in shown for word in name.split()}
    assert {"illumination", "Photobleaching", "brightness"} <= words and len(shown) == len(history)


def test_evidence_marks_what_cannot_be_told_apart():
    with plotting.style("light") as palette:
        ax = plotting.figure().add_subplot()
        plotting.evidence(ax, report().ranking)
        from matplotlib.colors import to_hex

        colours = [to_hex(bar.get_facecolor()) for bar in ax.containers[0]][::-1]
    assert colours[:3] == [palette.after, palette.before, palette.muted]


def test_lines_of_nothing_but_nan_are_not_in_the_legend():
    made, _ = draw("distribution", "light", 6.4)
    labels = [text.get_text() for text in made.axes[0].get_legend().get_texts()]
    assert labels == ["measured", "this model, W1 = 0.3"]


@pytest.mark.parametrize(
    ("value", "sd", "told"),
    [(1.5234, 0.042, "1.523 ± 0.042"), (41.7, 3.2, "41.7 ± 3.2"), (5.0, None, "5"), (412.0, 30.0, "412 ± 30")],
)
def test_numbers_have_the_digits_their_uncertainty_allows(value, sd, told):
    assert wording.number(value, sd) == told


def test_parameters_are_told_with_units():
    lines = wording.parameter_lines(candidate("triplet_blinking", 1.0, None))
    assert lines == ["off rate = 5.20 ± 0.40 1/s", "dark time = 0.0410 ± 0.0030 s", "form = exponential"]
    assert wording.parameter_label("stage_drift", "distance_px") == ("distance", "px")
    assert wording.parameter_label("not_installed", "some_thing") == ("some thing", "")


# --- the page ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def page() -> str:
    return html_report.render(report(), traces=TRACES, subtitle="a <b>movie</b>")


def test_the_page_needs_nothing_from_outside(page):
    assert not re.search(r"""(?:src|href|srcset|url)\s*[=(]\s*["']?(?!data:|#)[^"'\s>]""", page)
    assert "http" not in re.sub(r"data:[^\"]+", "", page)
    assert page.count("prefers-color-scheme: dark") == page.count("<picture>") >= 6


def test_the_page_says_what_is_missing_and_how_to_check(page):
    from napari_mufasa.effects import effect_class

    effect = effect_class("triplet_blinking")
    for words in (effect.title, effect.what_it_is, effect.what_it_does, effect.how_to_check, effect.separated_by):
        assert words in page
    assert "Missing from the model: fast dark-state blinking." in page
    assert "falls from 2.93 to 1.04; noise alone gives 0.98" in page
    assert "dark time = 0.0410 ± 0.0030 s" in page


def test_names_from_files_cannot_inject_markup(page):
    assert "a &lt;b&gt;movie&lt;/b&gt;" in page and "<b>" not in page
    assert "Background &lt;mean&gt;" in page


def test_names_of_files_and_layers_stay_words(monkeypatch):
    """Wherever a name of others' may stand: a script there is text, and the page stays one tree."""
    script = "<script>alert('x')</script>"
    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": script, "dark": script})
    monkeypatch.setattr(figures, "effect_title", lambda kind: script)
    named = report()
    table = named.observables.assign(title=script, where=script, unit=script)
    unknown = replace(named.ranking[1], effect=script, parameters={script: script})
    named = replace(
        named, observables=table, ranking=[named.ranking[0], unknown], notes=[script], detectable={script: 1.0}
    )
    text = html_report.render(named, title=script, subtitle=f"{script}.tif", traces=TRACES, extra=[(script, script)])
    tree = Tree()
    tree.feed(text)
    assert "script" not in tree.seen and tree.open == []
    assert text.count("&lt;script&gt;") >= 2 * len(table) + 8


class Tree(HTMLParser):
    """The elements of a page; fails where one is closed that is not open."""

    EMPTY = frozenset({"meta", "source", "img"})

    def __init__(self):
        super().__init__()
        self.open: list[str] = []
        self.seen: set[str] = set()

    def handle_starttag(self, tag, attrs):
        self.seen.add(tag)
        if tag not in self.EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_the_model_on_the_page_is_the_completed_model(page):
    import html
    import json

    from napari_mufasa.model.model import Model

    text = html.unescape(re.search(r"<pre id=model>(.*?)</pre>", page, re.S).group(1))
    assert Model.from_dict(json.loads(text)) == report().model


@pytest.mark.parametrize(
    ("verdict", "line"),
    [
        ("adequate", "The model explains this measurement."),
        ("unexplained", "Something is missing that no known effect explains."),
    ],
)
def test_the_other_verdicts_have_their_words(verdict, line, monkeypatch):
    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": "", "dark": ""})
    text = html_report.render(report(verdict))
    assert line in text and "Not seen is not absent" in text


def test_an_effect_that_was_not_added_is_told_as_a_lead():
    import dataclasses

    base = dataclasses.replace(report("unexplained"), verdict="missing_effect")
    line, sentence = wording.verdict_text(base)
    assert line == "Something is missing. Fast dark-state blinking explains it best."
    assert "from 2.93 to 1.04; noise alone gives 0.98" in sentence
    worse = dataclasses.replace(base, ranking=[dataclasses.replace(base.ranking[0], error_after=3.0)])
    assert "no effect tried lowers the error" in wording.verdict_text(worse)[0]


def test_a_good_model_with_a_rest_does_not_read_like_a_failure(monkeypatch):
    """Headline, page and terminal say both: what is explained, and that something stays off."""
    import dataclasses

    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": "", "dark": ""})
    good = dataclasses.replace(report(), verdict="unexplained")
    line, sentence = wording.verdict_text(good)
    assert line == "99.4 % of the misfit is explained by fast dark-state blinking; the rest by no known effect."
    assert "from 2.93 to 1.04; noise alone gives 0.98" in sentence
    few = dataclasses.replace(good, suspects=["triplet_blinking", "laser_drift"])
    assert "the rest by none of those that were considered" in wording.verdict_text(few)[0]
    short = dataclasses.replace(good, cut_short=True, simulations={"spent": 680, "budget": 700})
    assert "the rest by nothing that the budget of 700 simulations left room to try" in wording.verdict_text(short)[0]
    untried = dataclasses.replace(short, chosen=[])
    line, _ = wording.verdict_text(untried)
    assert line.startswith("Something is missing; the budget of 700 simulations left no room to try what. It resembles")
    told = wording.standing_lines(good)
    assert told == [
        "99.4 % of the misfit is explained, to 1.06 times the error that noise alone gives.",
        "With 1.4 times fewer molecules or frames nobody could tell model and movie apart "
        "(21 times for the model believed).",
        "One of these, and the data cannot tell which: fast dark-state blinking or long dark state.",
        "Still off: Spot width, 1.29 measured, 1.28 simulated px (+4 sd).",
    ]
    page = html_report.render(good)
    assert all(text in page and f"  {text}" in wording.summary(good) for text in told)
    assert wording.standing_lines(report("adequate")) == []
    doubted = dataclasses.replace(good, alternatives=[], inclusion={"triplet_blinking": 0.66})
    assert any(
        line.startswith("Not sure: fast dark-state blinking (66 %). ") for line in wording.standing_lines(doubted)
    )
    for of_two in (dataclasses.replace(doubted, alternatives=good.alternatives), good):  # which says so itself
        assert not any("Not sure" in line for line in wording.standing_lines(of_two))
    same = dataclasses.replace(good, credibility=1.0, explained=0.9999, remaining=[], alternatives=[])
    assert wording.standing_lines(same)[0].startswith("99.9 % of") and len(wording.standing_lines(same)) == 2


def test_names_are_listed():
    assert [wording.listed("abc"[:n]) for n in range(4)] == ["", "a", "a and b", "a, b and c"]


def test_what_is_still_off_is_told(monkeypatch):
    import dataclasses

    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": "", "dark": ""})
    off = report()
    table = off.observables.copy()
    table.loc[9, "z_after"] = 6.4
    assert "1 of 10 observables stays more than 3" in html_report.render(dataclasses.replace(off, observables=table))


def test_export_writes_every_file_whole(tmp_path, monkeypatch):
    import json

    from napari_mufasa.model.model import Model

    monkeypatch.setattr(html_report, "_picture", lambda drawing: {"light": "", "dark": ""})
    html_report.export(tmp_path, report(), TRACES)
    names = {path.name for path in tmp_path.iterdir()}
    assert {"report.json", "report.html", "model.json", "observables.csv"} <= names
    assert {f"{d.name}.png" for d in figures.diagnosis_drawings(report(), TRACES)} <= names
    assert json.loads((tmp_path / "report.json").read_text())["error"]["after"] == 1.04
    assert Model.from_json(tmp_path / "model.json") == report().model
    assert len(pd.read_csv(tmp_path / "observables.csv")) == 10


@pytest.mark.parametrize("added", [True, False])
def test_distances_show_one_model_until_an_effect_is_added(added):
    table = report().observables
    ax = Figure().add_subplot()
    plotting.z_scores(ax, table if added else table.assign(z_after=table.z_before))
    assert len([line for line in ax.lines if line.get_marker() == "o"]) == 1 + added


def test_a_map_of_few_values_has_them_as_ticks():
    across, up = "excitation.power_density_w_per_cm2", "optics.psf_fwhm_nm"
    table = pd.DataFrame({across: [1.0, 10, 1, 10], up: [250.0, 250, 300, 300], "snr_spot": [1.0, 7, 1, 6]})
    made = Figure()
    plotting.predictions(made, table, [across, up], ["snr_spot"])
    assert list(made.axes[0].get_xticks()) == [1, 10] and list(made.axes[0].get_yticks()) == [250, 300]


@pytest.mark.parametrize("values", [["FF", "STORM"], [None, 1000.0]])
def test_what_has_no_place_on_an_axis_is_told_in_the_place_of_curves(values):
    made = Figure()
    plotting.predictions(made, pd.DataFrame({"protocol": values, "snr_spot": [1.0, 2.0]}), ["protocol"], ["snr_spot"])
    (ax,) = made.axes
    assert not ax.lines and any("vary numbers" in text.get_text() for text in ax.texts)


def test_the_distance_that_was_asked_for_is_among_those_shown():
    table = report().observables
    least = table.loc[table["z_before"].abs().idxmin()]
    ax = Figure(figsize=(4, 2)).add_subplot()
    plotting.z_scores(ax, table, also=least["observable"])
    assert any(least["title"].lower() in text.get_text().lower() for text in ax.texts)
    assert len(ax.texts) < len(table)
