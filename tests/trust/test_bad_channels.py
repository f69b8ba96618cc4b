"""Bad input at the doors of two channels: register, --channel, --channels, and their Python functions."""

from __future__ import annotations

import numpy as np
import pytest
from tests.trust.broken_files import MOVIES
from tests.trust.refusal import BAD_STACKS, MODEL, check_line, refused

import napari_mufasa as nm
from napari_mufasa.errors import MufasaError

OUT = "--out out/c.json"
TRACES = "traces good/movie.tif --model good/model.json --out out/t"
BAD_COMMANDS: dict[str, tuple[str, str]] = {
    "nothing": ("register", "missing argument"),
    "nowhere": ("register good/movie.tif", "--out"),
    "no file": (f"register none.tif {OUT}", "no file"),
    "a model": (f"register good/model.json {OUT}", "not a readable movie"),
    "no folder": ("register good/movie.tif --out out/none/c.json", "no folder"),
    "over the beads": ("register good/movie.tif --out good/movie.tif --overwrite", "is also read"),
    "over a model": ("register good/movie.tif --out good/model.json", "--overwrite"),
    "figure and channels are one": (f"register good/movie.tif {OUT} --figure out/c.json", "twice"),
    "no rectangle": (f"register good/movie.tif {OUT} --donor middle", "left, right"),
    "a rectangle that is too large": (f"register good/movie.tif {OUT} --donor 0:999,0:9", "leaves the frames"),
    "a rectangle that is too small": (f"register good/movie.tif {OUT} --donor 0:3,0:9", "narrower"),
    "rectangles that overlap": (f"register good/movie.tif {OUT} --donor left --acceptor left", "share pixels"),
    "an unknown kind": (f"register good/movie.tif {OUT} --kind cubic", "cubic"),
    "traces: no rectangle": (f"{TRACES} --channel centre", "left, right"),
    "traces: a channel that leaves the frames": (f"{TRACES} --channel 0:9,0:999", "leaves the frames"),
    "traces: one channel and two": (f"{TRACES} --channel left --channels good/model.json", "one of them"),
    "traces: two channels on a cluster": (
        f"{TRACES} --channels good/model.json --scheduler tcp://host:1", "drop it, or --channels",
    ),
    "register: a figure of another kind": (f"register good/movie.tif {OUT} --figure out/f.pdf", "use .png or .svg"),
    "traces: channels that are missing": (f"{TRACES} --channels none.json", "no file"),
    "traces: channels that are a model": (f"{TRACES} --channels good/model.json", "no channels.json"),
    "traces: channels that are a movie": (f"{TRACES} --channels good/movie.tif", "not readable"),
    "traces: leakage without channels": (f"{TRACES} --leakage 0.1", "--channels"),
    "traces: gamma without channels": (f"{TRACES} --gamma 2", "--channels"),
    "traces: leakage in percent": (f"{TRACES} --leakage 10", "--leakage"),
    "traces: no gamma": (f"{TRACES} --gamma 0", "--gamma"),
    "traces: found in neither": (f"{TRACES} --find-in acceptor", "acceptor"),
    "denoise: no rectangle": (
        "denoise good/movie.tif --model good/model.json --out out/d.tif --channel 1,2,3,4", "left, right",
    ),
    "diagnose: no rectangle": (
        "diagnose good/movie.tif --model good/model.json --out out/d --channel 9:1,0:9", "narrower",
    ),
    "diagnose: a channel of a table": (
        "diagnose in/traces.csv --traces --model good/model.json --out out/d --channel left", "belongs to a movie",
    ),
}  # fmt: skip


#: Movies that have no room for two channels, which is seen before a pixel is read; and counts that may be beads in
#: another unit than a camera's.
REFUSED_OTHERWISE: dict[str, str] = {"zarr, cut chunk": "narrower", "negative": "no spot stands out"}


@pytest.mark.parametrize("case", BAD_COMMANDS)
def test_a_command(case, capfd, more):
    words, expected = BAD_COMMANDS[case]
    refused(capfd, more, expected, *words.split())


@pytest.mark.parametrize("case", MOVIES)
def test_a_movie_file_to_register(case, capfd, place):
    make, word = MOVIES[case]
    movie = make(place / "in")
    if case in REFUSED_OTHERWISE:
        word = REFUSED_OTHERWISE[case]
    refused(capfd, place, word, "register", movie, "--out", "out/c.json")


@pytest.mark.parametrize("case", BAD_STACKS)
def test_an_array_to_register(case):
    with pytest.raises(MufasaError) as told:
        nm.register(BAD_STACKS[case])
    check_line(str(told.value), "")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        ((None, MODEL.camera, None), "channels"), ((np.zeros((3, 9, 9)), MODEL.camera, {}), "channels"),
        ((np.zeros((3, 9, 9)), MODEL.camera, "c.json"), "channels"),
    ],
)  # fmt: skip
def test_a_pair(arguments, word):
    with pytest.raises(MufasaError) as told:
        nm.extract_pair(*arguments)
    check_line(str(told.value), word)


def test_there_are_enough_cases():
    assert len(BAD_COMMANDS) + len(MOVIES) + len(BAD_STACKS) >= 60
