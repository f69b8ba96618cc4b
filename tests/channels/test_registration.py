"""Registration against splitters whose map is known (docs/two_channels.md)."""

from __future__ import annotations

import json

import numpy as np
import pytest
from tests.channels.splitter import BRIGHT, MODEL, everywhere, splitter
from tests.real_data import real_data

from napari_mufasa import optics
from napari_mufasa.channels import Channels, Rectangle, register, simulate_pair
from napari_mufasa.channels.matching import match
from napari_mufasa.channels.registration import from_places
from napari_mufasa.channels.transform import bends, fit, rms_px
from napari_mufasa.errors import MufasaError

LEFT, RIGHT, FRAME = Rectangle(0, 512, 0, 256), Rectangle(0, 512, 256, 512), (512, 512)
FIELD = np.array([[20.0, 20.0], [490.0, 235.0]])


def scattered(n: int, rng: np.random.Generator):
    return rng.uniform(*FIELD, (n, 2))


def measured(there, n: int, rng: np.random.Generator, sd_px: float = 0.1, strangers: int = 0):
    """Places in both channels: n common ones, and as many strangers in each; in an order that says nothing."""
    common = scattered(n, rng)
    donor, acceptor = (
        np.concatenate([places + rng.normal(0, sd_px, places.shape), scattered(strangers, rng)])
        for places in (common, there(common))
    )
    return rng.permutation(donor), rng.permutation(acceptor)


WIDE = {"centre_px": np.array([255.5, 127.5])}
SPLITTERS = {
    "identity": splitter(0, 1, (0, 0), **WIDE), "shift": splitter(0, 1, (30.4, -21.7), **WIDE),
    "rotation": splitter(4.0, 1, (0, 0), **WIDE), "backwards": splitter(-3.0, 0.97, (-8, 12), **WIDE),
    "all": splitter(1.5, 1.03, (-12.2, 7.1), **WIDE), "bent": splitter(1.0, 1.01, (5.0, 3.0), 2.0, **WIDE),
}  # fmt: skip


@pytest.mark.parametrize("strangers", [0, 40])
@pytest.mark.parametrize("name", SPLITTERS)
def test_a_known_map_is_found(name, strangers):
    """The mapped places are off by what the transform says, all over the channel."""
    rng, there = np.random.default_rng(sum(map(ord, name)) + strangers), SPLITTERS[name]
    donor, acceptor = measured(there, 60, rng, strangers=strangers)
    found = from_places(donor, acceptor, LEFT, RIGHT, FRAME)
    assert found.transform.kind == ("polynomial" if name == "bent" else "affine")
    assert 57 <= len(found.donor_px) <= 60 + strangers // 10
    places = everywhere((512, 256), 30)
    off, sd = found.transform(places) - there(places), found.transform.sd_at(places)
    assert np.sqrt(np.mean((off / sd[:, None]) ** 2)) < 3  # the errors of all places hang together
    # Each place is measured to 0.1 px along each axis, in both channels.
    assert found.residual_px.value == pytest.approx(np.sqrt(4) * 0.1, rel=0.25)


def test_rotation_scale_and_shift_are_those_of_the_splitter():
    rng = np.random.default_rng(3)
    covered = {"rotation_deg": 0, "scale": 0}
    for _ in range(100):
        places = scattered(30, rng)
        found, _ = fit(places, SPLITTERS["all"](places) + rng.normal(0, 0.1, places.shape), "affine")
        covered["rotation_deg"] += found.rotation_deg.low <= 1.5 <= found.rotation_deg.high
        covered["scale"] += found.scale.low <= 1.03 <= found.scale.high
    # 95 of 100, sd 2.2
    assert min(covered.values()) >= 88


def test_the_interval_of_the_residual_holds_its_expectation():
    """Left out, a pair of n is off by more than its own error; over many recordings the mean square is known."""
    rng, there = np.random.default_rng(4), SPLITTERS["all"]
    made = []
    for _ in range(300):
        places = scattered(20, rng)
        made.append(fit(places, there(places) + rng.normal(0, 0.2, (20, 2)), "affine"))
    expected = np.sqrt(np.mean([np.square(left_out).sum(axis=1).mean() for _, left_out in made]))
    inside = [
        rms_px(left_out, map_.freedom).low <= expected <= rms_px(left_out, map_.freedom).high for map_, left_out in made
    ]
    assert 0.88 <= np.mean(inside) <= 1.0


def test_left_out_is_what_a_fit_without_the_pair_says():
    rng = np.random.default_rng(5)
    places = scattered(15, rng)
    there = SPLITTERS["all"](places) + rng.normal(0, 0.2, places.shape)
    for kind in ("affine", "polynomial"):
        _, left_out = fit(places, there, kind)
        for i in range(3):
            others = np.arange(15) != i
            without, _ = fit(places[others], there[others], kind)
            np.testing.assert_allclose(there[i] - without(places[i]), left_out[i], atol=1e-6)


def test_a_straight_map_is_seldom_called_bent():
    rng = np.random.default_rng(6)
    called = 0
    for _ in range(400):
        places = scattered(25, rng)
        called += bends(places, SPLITTERS["all"](places) + rng.normal(0, 0.1, places.shape), 0.01)
    assert called <= 11  # 4 expected, sd 2


def test_unrelated_spots_are_refused():
    rng = np.random.default_rng(7)
    for n in (8, 30, 200):
        for _ in range(5):
            with pytest.raises(MufasaError, match="match"):
                match(scattered(n, rng), scattered(n, rng))


@pytest.fixture(scope="module")
def beads():
    return simulate_pair(BRIGHT, 0.5, splitter(), seed=5)


def test_beads_of_a_simulated_splitter(beads):
    found = register(beads.movie, "left", "right")
    places = everywhere()
    off = found.transform(places) - splitter()(places)
    assert np.sqrt(np.mean(off**2)) < 0.05
    assert found.residual_px.value < 0.15 and len(found.donor_px) >= 20
    assert (found.donor, found.acceptor) == (Rectangle(0, 96, 0, 96), Rectangle(0, 96, 96, 192))
    image = register(beads.movie.mean(axis=0), "0:96,0:96", "0:96,96:192")
    np.testing.assert_allclose(image.transform(places), found.transform(places), atol=0.05)


def test_molecules_of_the_movie_itself_do_as_well():
    pair = simulate_pair(MODEL, 0.5, splitter(), seed=8)
    found = register(pair.movie)
    places = everywhere()
    assert np.sqrt(np.mean((found.transform(places) - splitter()(places)) ** 2)) < 0.1


def test_the_file_gives_the_same_back(beads, tmp_path):
    found = register(beads.movie, kind="polynomial")
    found.to_json(tmp_path / "channels.json")
    again = Channels.from_json(tmp_path / "channels.json")
    np.testing.assert_allclose(again.transform(everywhere()), found.transform(everywhere()), atol=1e-9)
    assert again.residual_px == found.residual_px and again.notes == found.notes
    data = json.loads((tmp_path / "channels.json").read_text())
    assert data["matched"] == len(found.donor_px) and data["summary"]["residual_px"]["value"] == found.residual_px.value


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda d: d.pop("transform"), "transform"), (lambda d: d["transform"].pop("spread"), "spread"),
        (lambda d: d["transform"].update(scale_px=0), "cannot be"), (lambda d: d.update(donor="left:right"), "channel"),
        (lambda d: d.update(acceptor=d["donor"]), "share pixels"), (lambda d: d.update(donor_px=[[1]]), "places"),
        (lambda d: d["transform"].update(kind="cubic"), "cubic"), (lambda d: d.update(frame_px=[]), "channels.json"),
        (lambda d: d["transform"].update(coefficients=[[1, 2]]), "anew"),
    ],
)  # fmt: skip
def test_a_bad_file_is_named(beads, tmp_path, change, word):
    path = tmp_path / "channels.json"
    register(beads.movie).to_json(path)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(MufasaError, match=word):
        Channels.from_json(path)


@pytest.mark.parametrize(
    ("options", "word"),
    [
        ({"donor": "left", "acceptor": "left"}, "share pixels"), ({"donor": "middle"}, "no rectangle"),
        ({"kind": "cubic"}, "kind"), ({"sigma_px": 0}, "sigma_px"), ({"acceptor": "0:96,96:400"}, "leaves"),
    ],
)  # fmt: skip
def test_bad_input_is_named(beads, options, word):
    with pytest.raises(MufasaError, match=word):
        register(beads.movie, **options)


def test_too_few_beads_are_told_in_one_line():
    few = simulate_pair(BRIGHT, 0.5, splitter(), [[20.0, 20.0], [70.0, 30.0], [40.0, 80.0]], seed=1)
    with pytest.raises(MufasaError, match=r"of 3 spots .* 3 of the acceptor's match, \d+ are needed: record more"):
        register(few.movie)
    empty = simulate_pair(BRIGHT, 0.5, splitter(), np.empty((0, 2)), seed=1)
    with pytest.raises(MufasaError, match="beads"):
        register(empty.movie)


@pytest.mark.realdata
def test_real_places_of_two_channels_belong_together():
    """Molecules of a real smFRET movie, as other software found them: stored to half a pixel, which is what is left."""
    table = np.loadtxt(real_data("smfret_traces/hel1.pks"))
    donor, acceptor = table[0::2][:, [2, 1]], table[1::2][:, [2, 1]] - [0, 256]
    shuffled = np.random.default_rng(0).permutation(len(donor))
    found = from_places(donor, acceptor[shuffled], LEFT, RIGHT, FRAME)
    rows = [int(np.flatnonzero((donor == place).all(axis=1))[0]) for place in found.donor_px]
    assert len(rows) >= 0.95 * len(donor)
    np.testing.assert_array_equal(found.acceptor_px, acceptor[rows])
    # Rounding to half a pixel along both axes of both places: 0.5/√12 · √4.
    assert found.residual_px.value == pytest.approx(0.289, rel=0.1)


def test_a_background_that_rises_in_one_channel_bends_no_map():
    """Beads of 1000 e on a hill of 200 e in the donor's channel alone: it drew them uphill by half a pixel."""
    rng = np.random.default_rng(8)
    places = np.stack(np.meshgrid(np.arange(12, 110, 14), np.arange(12, 110, 14), indexing="ij"), -1).reshape(-1, 2)
    places = places + rng.uniform(-0.5, 0.5, places.shape)
    hill = 200 * np.exp(-((np.mgrid[:120, :120] - 60) ** 2).sum(axis=0) / 2 / 40**2)
    spots = optics.spot_images(np.full((1, len(places)), 1000.0), places[None], np.full((1, 2), 1.3), (120, 120))[0]
    beads = rng.poisson(np.concatenate([spots + hill, spots], axis=1) + 10, (20, 120, 240)).astype(np.uint16)
    found = register(beads, sigma_px=1.3)
    off = found.transform(places) - places
    assert len(found.donor_px) == len(places) and np.sqrt(np.mean(off**2)) < 0.04
