"""Every code block of the README and of the pages runs, in the order of its page.

In a folder that has what a reader would have: a movie, its dark frames, a model, traces; small ones, and stand-ins
for the real movies. What takes long is made small: large movies are simulated smaller, and a diagnosis considers
two effects.
"""

from __future__ import annotations

import re
import shlex
import shutil
from contextlib import redirect_stdout
from io import StringIO
from itertools import pairwise

import numpy as np
import pytest
import tifffile
from tests.docs.blocks import ROOT, blocks_of, commands_of

import napari_mufasa as nm
from napari_mufasa import discover
from napari_mufasa.cli import main
from napari_mufasa.files.traces import write_trace_file

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
RUN = {"python", "bash"}
SUSPECTS = ["photobleaching", "stage_drift"]
CORNER = 64  # px
LARGE = 10**6  # pixels × frames: movies beyond are simulated smaller
#: Words of a shell that the blocks use; any other command is marked with the reason why it is not run.
COMMANDS = ("napari-mufasa", "python")
#: Followed by a test of its own, from its first line to its last.
ELSEWHERE = {"your_effect.md": "tests/effects/test_plugin_package.py"}


def pages_with_code():
    return [page for page in PAGES if page.name not in ELSEWHERE and any(b.language in RUN for b in blocks_of(page))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_stand_in_blocks_that_are_run_or_say_why_not(page):
    for block in blocks_of(page):
        if block.language not in RUN:
            assert not re.search(r"^(\$ )?(napari-mufasa|python|pip|make|git) ", block.code, re.MULTILINE) or (
                block.reason
            ), f"{page.name}:{block.line}"
        if block.language == "bash" and not block.reason and page.name not in ELSEWHERE:
            unknown = [c for c in commands_of(block.code) if not c.startswith(COMMANDS)]
            assert not unknown, f"{page.name}:{block.line}: say why {unknown} is not run"
    for name, test in ELSEWHERE.items():
        assert name in (ROOT / test).read_text()


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """Movies of a bright model, as files; a model that is right, but for what blocks take away."""
    folder = tmp_path_factory.mktemp("recorded")
    real = nm.Model.from_json(ROOT / "docs" / "models" / "smfret_ixon.json")
    model = nm.preset("FF").with_values(
        {
            "acquisition.n_frames": 60, "acquisition.shape_px": (48, 48), "camera": real.camera.model_dump(),
            "excitation.power_density_w_per_cm2": 20, "fluorophore.cycles_before_bleaching": 3e4,
            "optics.background_photons_per_px": 10, "sample.n_molecules": 12, "sample.min_distance_px": 9,
        }
    )  # fmt: skip
    movies = [nm.simulate(model, seed=seed).movie for seed in (1, 2)]
    for name in ("movie.tif", "smfret_ixon_emccd.tif", "movies/first/1.tif", "movies/second/1.tif"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        movie = movies["second" in name]
        tifffile.imwrite(folder / name, movie[:40, :40, :40] if "/" in name else movie, metadata={"axes": "TYX"})
    tifffile.imwrite(folder / "dark.tif", nm.simulate_dark(model, 40, seed=3), metadata={"axes": "TYX"})
    (folder / "list.csv").write_text("movie,condition\nmovies/first/1.tif,first\nmovies/second/1.tif,second\n")
    model.to_json(folder / "model.json")
    found = nm.extract_traces(movies[0], model.camera, psf_sigma_px=model.sigma_px)
    write_trace_file(folder / "traces.csv", found.traces)
    light = np.random.default_rng(4).poisson(nm.simulate_emission(model, 40, seed=4) * 0.1)
    tifffile.imwrite(folder / "egfp_emccd_traces.tif", (367 + 676 * light.T).astype(np.uint16))
    (folder / "docs").symlink_to(ROOT / "docs")
    return folder, model, movies[0], found.traces


@pytest.fixture
def small(monkeypatch):
    """Two suspects, one at most to be added, few simulations and a corner of the movie, wherever a diagnosis is asked
    for."""
    few = {"max_effects": 1, "budget": 50}
    movies, tables = discover.diagnose, discover.diagnose_traces

    def diagnose(movie, model, dark=None, **given):
        dark = None if dark is None else dark[:, :CORNER, :CORNER]
        return movies(movie[:60, :CORNER, :CORNER], model, dark, **(given | few | {"effects": SUSPECTS}))

    def diagnose_traces(traces, model, **given):
        return tables(traces=traces, model=model, **(given | few | {"effects": SUSPECTS[:1]}))

    for made in (diagnose, diagnose_traces):
        monkeypatch.setattr(discover, made.__name__, made)
        monkeypatch.setitem(vars(nm), made.__name__, made)


@pytest.mark.parametrize("page", pages_with_code(), ids=lambda page: page.name)
def test_the_blocks_of_a_page_run_in_their_order(page, recorded, small, tmp_path, monkeypatch, request):
    folder, model, movie, traces = recorded
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True, symlinks=True)
    for made in re.findall(r"(?:--out|>) (\S+)$|--out (\S+)", page.read_text(encoding="utf-8"), re.MULTILINE):
        (tmp_path / "".join(made)).unlink(missing_ok=True)  # the page makes it
    monkeypatch.chdir(tmp_path)
    # What pages speak of without making it.
    known = {"movie": movie, "model": model, "image": movie[0] / 19.0, "frames": movie[:8] / 19.0, "table": traces}
    if any("widgets" in block.code for block in blocks_of(page)):
        request.getfixturevalue("qapp")
    for block in blocks_of(page):
        if block.reason or block.language not in RUN:
            continue
        try:
            if block.language == "python":
                exec(compile(block.code, f"{page.name}:{block.line}", "exec"), known)
            else:
                for command in commands_of(block.code):
                    run(command)
        except (Exception, SystemExit) as error:
            raise AssertionError(f"{page.name}:{block.line}: {error!r}") from error


def run(command: str) -> None:
    """A line of a shell: one of our verbs, its output into a file where the line says so."""
    words, _, target = command.partition(" > ")
    arguments = smaller(shlex.split(words)[1:])
    said = StringIO()
    with redirect_stdout(said), pytest.raises(SystemExit) as left:
        main(arguments)
    assert not left.value.code, f"{command}: exit code {left.value.code}"
    if target:
        with open(target.strip(), "w", encoding="utf-8") as file:
            file.write(said.getvalue())


def smaller(arguments: list[str]) -> list[str]:
    """A simulation of a large movie, made small."""
    if arguments[0] != "simulate":
        return arguments
    given = dict(pairwise(arguments))
    made = nm.preset(given["--preset"]) if "--preset" in given else nm.Model.from_json(given["--model"])
    height, width = made.acquisition.shape_px
    if made.acquisition.n_frames * height * width <= LARGE:
        return arguments
    return [*arguments, "--frames", "60", "--shape", "64", "64", "--n-molecules", "14"]
