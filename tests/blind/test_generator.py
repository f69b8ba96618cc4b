"""Laws of the blind generator: the camera, the spots, the clocks, and every effect at zero and at strength.

Unless a comment says otherwise tolerances are at least five standard errors of the quantity, so a false alarm
is rarer than one in a million per comparison; seeds are fixed.
"""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from tests.spec_example import EFFECTS as CONTRACT

from . import generator as g
from . import photophysics
from .bases import PROTOCOLS, excitation_rate_per_s, sigma_px
from .world import SUBSTEPS, World, build

HERE = Path(__file__).parent
TRIAL = {"trial.py", "running.py"}
GENERATOR_FILES = sorted(p for p in HERE.glob("*.py") if not p.name.startswith("test_") and p.name not in TRIAL)
ALL_FORMS = [(kind, i) for kind in g.EFFECTS for i in range(len(g.forms(kind)))]
GAIN_ADU = 25.0  # 300 e per electron over 12 e per ADU


def small(n_frames: int = 120, side: int = 64, **background: float) -> dict:
    model = g.base_model("emccd_short")
    model["acquisition"].update(n_frames=n_frames, shape_px=[side, side])
    model["optics"].update(background)
    return model


def case(kind: str, strength: float, *, form: int = 0, n: int = 0, seed: int = 3, **model: float) -> g.BlindMovie:
    return g.make(small(**model), effects=[(kind, strength)], seed=seed, nuisance=0.0, n_molecules=n, form=form)


def hidden_world(kind: str, strength: float, form: int, n: int = 400, seed: int = 1, n_frames: int = 300) -> World:
    """The world after one effect, before any photon: for laws of the molecules themselves."""
    model = small(n_frames=n_frames)
    world = build(model, n, 100, np.random.default_rng(seed))
    g.EFFECTS[kind][0](world, strength, form, np.random.default_rng([seed, 1]))
    return world


def parameters(blind: g.BlindMovie) -> dict:
    return blind.truth["effects"][0]["parameters"]


# ---- independence and contract --------------------------------------------------------------------------
@pytest.mark.parametrize("path", GENERATOR_FILES, ids=lambda p: p.name)
def test_the_generator_imports_nothing_of_the_package(path: Path) -> None:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        else:
            continue
        assert not any(name.split(".")[0] == "napari_mufasa" for name in names), names
    assert "import_module" not in path.read_text() and "__import__" not in path.read_text()


def test_running_the_generator_never_loads_the_package() -> None:
    code = (
        "import sys, tests.blind.generator as g; g.make(g.base_model('emccd_short'), seed=1);"
        "print([m for m in sys.modules if m.startswith('napari')])"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=HERE.parents[1], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_the_catalogue_is_the_contract() -> None:
    assert sorted(g.EFFECTS) == sorted(CONTRACT)
    assert all(len(g.forms(kind)) >= 2 for kind in CONTRACT)
    assert len(g.OFF_CATALOGUE) == 8


def test_truth_is_json_and_the_belief_stays_clean() -> None:
    believed = g.base_model("emccd_short")
    before = json.dumps(believed)
    blind = g.make(believed, effects=[("stage_drift", 0.5), ("hot_pixels", 0.5)], seed=4)
    assert json.dumps(believed) == before == json.dumps(blind.believed)
    truth = json.loads(json.dumps(blind.truth))
    assert [e["kind"] for e in truth["effects"]] == ["stage_drift", "hot_pixels"]
    assert blind.movie.dtype == blind.dark.dtype == np.uint16
    assert blind.movie.shape == (120, 64, 64) and blind.dark.shape == (100, 64, 64)


def test_same_seed_same_movie_other_seed_other_movie() -> None:
    first, again, other = (g.make(g.base_model("emccd_short"), seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first.movie, again.movie)
    np.testing.assert_array_equal(first.dark, again.dark)
    assert (first.movie != other.movie).mean() > 0.9
    assert first.truth["positions_px"] != other.truth["positions_px"]


def test_nuisance_stays_in_its_box_and_fills_it() -> None:
    factors = [g._start(small(), s, 0.12, 1)[1]["nuisance"] for s in range(200)]
    for key in ("brightness_factor", "background_factor", "psf_width_factor"):
        values = np.array([f[key] for f in factors])
        assert abs(values - 1).max() <= 0.12
        # P(all 200 uniform draws miss the outer tenth on a side) = 0.95**200 = 3.5e-5
        assert values.min() < 0.89 and values.max() > 1.11
    assert max(abs(f["baseline_shift_adu"]) for f in factors) <= 4.0


def test_nuisance_reaches_the_world() -> None:
    right, wrong = (g._start(small(), 5, nuisance, 1) for nuisance in (0.0, 0.12))
    factors = wrong[1]["nuisance"]
    for name, factor in (
        ("photons_per_s", "brightness_factor"),
        ("background_photons", "background_factor"),
        ("sigma_px", "psf_width_factor"),
    ):
        assert getattr(wrong[0], name) / getattr(right[0], name) == pytest.approx(factors[factor])
        assert factors[factor] != 1.0
    shift = wrong[0].camera.baseline_adu - right[0].camera.baseline_adu
    assert shift == pytest.approx(factors["baseline_shift_adu"]) and shift != 0


@pytest.mark.parametrize(("kind", "strength"), [("no_such", 0.5), ("stage_drift", 1.5), ("stage_drift", -0.1)])
def test_bad_requests_are_refused(kind: str, strength: float) -> None:
    with pytest.raises(ValueError, match=kind):
        g.make(small(), effects=[(kind, strength)], seed=1)


# ---- the base world -------------------------------------------------------------------------------------
def test_check_value_of_the_excitation_rate() -> None:
    model = small()
    model["excitation"]["power_density_w_per_cm2"] = 2
    assert excitation_rate_per_s(model) == pytest.approx(1050.15, abs=0.01)


def test_emccd_flat_field_has_twice_the_poisson_variance() -> None:
    blind = g.make(small(), seed=2, nuisance=0.0, n_molecules=0)
    signal_e = 0.9 * 10 + 0.002
    n = blind.movie.size
    variance = 2 * GAIN_ADU**2 * signal_e + (50 / 12) ** 2 + 1 / 12
    # the floor takes half a unit off on average
    assert blind.movie.mean() == pytest.approx(200 - 0.5 + GAIN_ADU * signal_e, abs=5 * np.sqrt(variance / n))
    # excess kurtosis of Poisson-Gamma here is below 2, so sd(var)/var < sqrt(4/n)
    assert blind.movie.var() == pytest.approx(variance, rel=5 * np.sqrt(4 / n))
    dark_mean = 200 - 0.5 + GAIN_ADU * 0.002
    dark_variance = 2 * GAIN_ADU**2 * 0.002 + (50 / 12) ** 2 + 1 / 12
    assert blind.dark.mean() == pytest.approx(dark_mean, abs=5 * np.sqrt(dark_variance / blind.dark.size))
    assert blind.dark.var() == pytest.approx(dark_variance, rel=0.05)


def test_ccd_and_cmos_flat_fields() -> None:
    ccd = g.base_model("ccd")
    ccd["acquisition"].update(n_frames=100, shape_px=[64, 64])
    movie = g.make(ccd, seed=2, nuisance=0.0, n_molecules=0).movie
    electrons = 0.9 * 25 + 0.002
    variance = (electrons + 36) / 1.5**2 + 1 / 12
    assert movie.mean() == pytest.approx(299.5 + electrons / 1.5, abs=5 * np.sqrt(variance / movie.size))
    assert movie.var() == pytest.approx(variance, rel=5 * np.sqrt(2.2 / movie.size))
    cmos = g.base_model("cmos")
    cmos["acquisition"].update(n_frames=60, shape_px=[64, 64])
    for background, expected_e, tolerance in (
        (10, 0.9 * 8.0, 0.03),
        (750, 180 + 0.4 * 400, 0.3),
        (3000, 640, 0.3),
    ):
        cmos["optics"]["background_photons_per_px"] = background
        movie = g.make(cmos, seed=2, nuisance=0.0, n_molecules=0).movie
        assert movie.mean() == pytest.approx(99.5 + expected_e / 0.5, abs=tolerance)


def test_one_spot_has_the_light_and_the_width_of_the_model() -> None:
    model = small(n_frames=300, side=41, background_photons_per_px=0.0)
    world = build(model, 1, 0, np.random.default_rng(0))
    world.positions_px = np.array([[20.3, 19.6]])
    movie, _ = g._run(world, seed=5)
    electrons = (movie.mean(axis=0) - (199.5 + GAIN_ADU * 0.002)) / GAIN_ADU
    y, x = np.mgrid[:41, :41]
    inside = (y - 20.3) ** 2 + (x - 19.6) ** 2 < 8**2
    total = electrons[inside].sum()
    k01 = 1050.15 * 15
    expected = k01 * 0.02 * 0.6 * 0.6 * 0.9
    assert total == pytest.approx(expected, abs=5 * np.sqrt(2 * expected / 300))
    assert (electrons * y)[inside].sum() / total == pytest.approx(20.3, abs=0.08)
    assert (electrons * x)[inside].sum() / total == pytest.approx(19.6, abs=0.08)
    variance = (electrons * (y - 20.3) ** 2)[inside].sum() / total
    # photons are binned: a pixel of width 1 adds 1/12
    assert variance == pytest.approx(sigma_px(model) ** 2 + 1 / 12, rel=0.08)


def test_photons_outside_the_field_are_lost_not_wrapped() -> None:
    model = small(n_frames=100, side=41, background_photons_per_px=0.0)
    world = build(model, 1, 0, np.random.default_rng(0))
    world.positions_px = np.array([[-0.5, 20.0]])
    movie, _ = g._run(world, seed=5)
    electrons = (movie.mean(axis=0) - (199.5 + GAIN_ADU * 0.002)) / GAIN_ADU
    expected = 0.5 * 1050.15 * 15 * 0.02 * 0.6 * 0.6 * 0.9
    assert electrons[:8, 12:29].sum() == pytest.approx(expected, abs=5 * np.sqrt(2 * expected / 100))
    assert abs(electrons[-8:]).max() < 0.2


def life_times_s(world: World, n: int, seed: int = 8) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([photophysics.bright_periods(world, 1.0, rng)[1][-1] for _ in range(n)])


def test_bleaching_is_exponential_with_the_rate_of_the_model() -> None:
    model = g.base_model("emccd_bleach")
    model["acquisition"]["n_frames"] = 5000  # 100 s: eight mean lives
    world = build(model, 1, 0, np.random.default_rng(0))
    lives = life_times_s(world, 2000)
    # Kolmogorov-Smirnov at 1e-6; the 1 in 2600 cut at the end of the movie is far below its resolution
    assert stats.kstest(lives, "expon", args=(0, 2e5 / excitation_rate_per_s(model))).pvalue > 1e-6


def test_bleaching_counts_light_not_time() -> None:
    model = g.base_model("emccd_bleach")
    model["acquisition"]["n_frames"] = 5000
    world = build(model, 1, 0, np.random.default_rng(0))
    world.light_t = np.where(np.arange(5000) < 2500, 0.0, 2.0)
    rng = np.random.default_rng(1)
    dose = np.array([photophysics.bright_periods(world, 0.5, rng)[1][-1] for _ in range(500)])
    assert dose.mean() == pytest.approx(12.7, rel=5 / np.sqrt(500))  # dose is light times time: the nominal life


def test_blinking_does_not_reset_the_fatal_dose() -> None:
    world = hidden_world("triplet_blinking", 0.7, 0, n_frames=3000)
    world.fatal_dose = lambda _rng: 1.5
    starts, ends, _ = photophysics.bright_periods(world, 1.0, np.random.default_rng(1))
    assert len(starts) > 5
    assert (ends - starts).sum() == pytest.approx(1.5)
    assert (starts[1:] >= ends[:-1] - 1e-12).all()


def test_dose_per_frame_conserves_light() -> None:
    starts, ends = np.array([0.5, 2.25, 6.0]), np.array([1.75, 2.5, 9.0])
    per_frame = photophysics.dose_per_frame(starts, ends, np.arange(11.0))
    np.testing.assert_allclose(per_frame, [0.5, 0.75, 0.25, 0, 0, 0, 1, 1, 1, 0], atol=1e-12)


def test_a_triplet_of_the_model_darkens_by_its_duty() -> None:
    model = small(n_frames=400)
    model["protocol"] = "Blinking"
    model["fluorophore"].update(isc_ratio=1e-3, triplet_decay_rate_per_s=20.0)
    world = build(model, 400, 0, np.random.default_rng(0))
    mean = photophysics.expected_photons(world, np.random.default_rng(1))
    k_isc = excitation_rate_per_s(model) * 1e-3
    assert mean[:, 0].mean() < 0.45 * world.photons_per_s * 0.02  # all start in the triplet (mean 50 ms)
    late = mean[:, 50:].mean() / (world.photons_per_s * 0.02)
    assert late == pytest.approx(20.0 / (20.0 + k_isc), rel=0.02)


# ---- strength zero --------------------------------------------------------------------------------------
_SAME = {}


@pytest.mark.parametrize(("kind", "form"), ALL_FORMS)
def test_strength_zero_is_the_base(kind: str, form: int) -> None:
    if not _SAME:
        _SAME["base"] = g.make(small(), seed=6, n_molecules=20)
    base = _SAME["base"]
    blind = g.make(small(), effects=[(kind, 0.0)], seed=6, n_molecules=20, form=form)
    for a, b in ((blind.movie, base.movie), (blind.dark, base.dark)):
        n = a.size
        assert float(a.mean()) == pytest.approx(float(b.mean()), abs=5 * np.sqrt(2 * b.var() / n))
        # 50: kurtosis of the dark frames, whose rare spurious electrons make a long tail
        assert float(a.std()) == pytest.approx(float(b.std()), rel=5 * np.sqrt(50 / n))
        # the whole distribution: Kolmogorov-Smirnov distance, critical value at 1e-6 is 2.7 sqrt(2/n)
        top = int(max(a.max(), b.max())) + 1
        gap = np.cumsum(np.bincount(a.ravel(), minlength=top) - np.bincount(b.ravel(), minlength=top)) / n
        assert abs(gap).max() < 2.7 * np.sqrt(2 / n)


# ---- strong: known results, molecules -------------------------------------------------------------------
@pytest.mark.parametrize("form", [0, 1, 2])
def test_triplet_blinking_has_its_dark_fraction(form: int) -> None:
    world = hidden_world("triplet_blinking", 0.7, form)
    bright = photophysics.expected_photons(world, np.random.default_rng(2)) / (world.photons_per_s * world.frame_s)
    assert bright[:, 30:].mean() == pytest.approx(1 - 0.49, abs=0.01)


@pytest.mark.parametrize("form", [0, 1, 2])
def test_long_dark_state_has_its_dark_fraction_in_the_long_run(form: int) -> None:
    world = hidden_world("long_dark_state", 0.7, form)
    longer = hidden_world("long_dark_state", 0.7, form, n=200, n_frames=6000)
    longer.dark_states = world.dark_states
    bright = photophysics.expected_photons(longer, np.random.default_rng(2)) / (world.photons_per_s * world.frame_s)
    # 200 molecules x ~100 visits, dwell times of cv up to 2: standard error below 0.008
    assert bright[:, 1500:].mean() == pytest.approx(1 - 0.7 * 0.7**1.3, abs=0.04)


@pytest.mark.parametrize("form", [0, 1, 2])
def test_photobleaching_has_its_mean_life(form: int) -> None:
    world = hidden_world("photobleaching", 1.0, form, n_frames=6000)
    world.fatal_dose = hidden_world("photobleaching", 1.0, form).fatal_dose
    lives = life_times_s(world, 2000)
    assert lives.mean() == pytest.approx(6.0 / np.log(5), rel=0.15)
    # one rate: cv 1; two populations: more; two steps: 1/sqrt 2
    cv = lives.std() / lives.mean()
    assert (0.9 < cv < 1.1, cv > 1.1, cv < 0.8)[form]


@pytest.mark.parametrize("form", [0, 1, 2])
def test_delayed_activation_leaves_its_share_dark_at_first(form: int) -> None:
    world = hidden_world("delayed_activation", 0.5, form, n=1000)
    mean = photophysics.expected_photons(world, np.random.default_rng(2))
    assert (mean[:, 0] == 0).mean() == pytest.approx(0.45, abs=0.08)
    assert (mean[:, -1] == 0).mean() < 0.1
    assert ((mean[:, 1:] == 0) & (mean[:, :-1] > 0)).sum() == 0  # once on, on


@pytest.mark.parametrize("form", [0, 1, 2])
def test_brightness_heterogeneity_keeps_the_mean_and_sets_the_spread(form: int) -> None:
    world = hidden_world("brightness_heterogeneity", 0.0, 0, n=1)
    world.brightness = np.ones(4000)
    g.EFFECTS["brightness_heterogeneity"][0](world, 0.5, form, np.random.default_rng(2))
    assert world.brightness.mean() == pytest.approx(1.0, abs=0.025)
    assert world.brightness.std() == pytest.approx(0.3, abs=0.03)


def test_multiple_emitters_add_their_light_and_bleach_in_steps() -> None:
    world = hidden_world("multiple_emitters", 1.0, 0, n=300)
    mean = photophysics.expected_photons(world, np.random.default_rng(2)) / (world.photons_per_s * world.frame_s)
    assert mean[:, 0].mean() == pytest.approx(1.9, abs=0.1)
    model = g.base_model("emccd_bleach")
    model["fluorophore"]["cycles_before_bleaching"] = 3e4
    world = build(model, 200, 0, np.random.default_rng(0))
    g.EFFECTS["multiple_emitters"][0](world, 1.0, 0, np.random.default_rng(1))
    level = photophysics.expected_photons(world, np.random.default_rng(2)) / (world.photons_per_s * world.frame_s)
    whole = np.isclose(level, np.rint(level), atol=1e-6)
    assert whole.mean() > 0.98 and set(np.unique(np.rint(level[whole]))) == {0.0, 1.0, 2.0}


# ---- strong: known results, light and motion ------------------------------------------------------------
def test_laser_drift_moves_background_and_spots_together_but_decay_moves_background_alone() -> None:
    def ends(blind: g.BlindMovie) -> tuple[float, float]:
        electrons = (blind.movie.astype(float) - 199.5) / GAIN_ADU
        early, late = electrons[:30].mean(axis=0), electrons[-30:].mean(axis=0)
        free = np.ones(early.shape, bool)
        boxes = []
        for y, x in np.rint(np.array(blind.truth["positions_px"])).astype(int):
            free[max(y - 5, 0) : y + 6, max(x - 5, 0) : x + 6] = False
            if 3 < y < 60 and 3 < x < 60:
                boxes.append((slice(y - 3, y + 4), slice(x - 3, x + 4)))
        e, l = early[free].mean(), late[free].mean()
        spots = [sum((im[b] - f).sum() for b in boxes) for im, f in ((early, e), (late, l))]
        return l / e, spots[1] / spots[0]

    laser = case("laser_drift", 1.0, n=20)
    change = parameters(laser)["relative_change"]
    expected = (1 + change * 0.875) / (1 + change * 0.125)
    background, spots = ends(laser)
    assert background == pytest.approx(expected, rel=0.02)
    assert spots == pytest.approx(expected, rel=0.06)
    background, spots = ends(case("background_decay", 1.0, form=2, n=20))
    assert background == pytest.approx((1 - 0.6 * 0.875) / (1 - 0.6 * 0.125), rel=0.02)
    assert spots == pytest.approx(1.0, rel=0.06)


def test_periodic_modulation_is_a_line_at_its_period() -> None:
    blind = case("periodic_modulation", 0.5, n_frames=300)
    frame_mean = blind.movie.mean(axis=(1, 2))
    spectrum = abs(np.fft.rfft((frame_mean - frame_mean.mean()) / (frame_mean.mean() - 199.5)))
    line = np.argmax(spectrum)
    assert line / 300 == pytest.approx(1 / parameters(blind)["period_frames"], abs=0.5 / 300)
    assert frame_mean.std() / (frame_mean.mean() - 199.5) == pytest.approx(0.2 * 0.5**1.5 / np.sqrt(2), rel=0.1)


@pytest.mark.parametrize("form", [0, 1, 2])
def test_laser_flicker_has_its_rms(form: int) -> None:
    blind = case("laser_flicker", 1.0, form=form, n_frames=300, side=32)
    frame_mean = blind.movie.mean(axis=(1, 2)) - 199.5
    # 300 samples of noise correlated over up to five frames: 60 independent ones, standard error 9 %
    assert frame_mean.std() / frame_mean.mean() == pytest.approx(0.10, rel=0.45 if form == 2 else 0.25)
    lag_1 = np.corrcoef(frame_mean[1:], frame_mean[:-1])[0, 1]
    assert abs(lag_1) < 0.3 if form == 0 else lag_1 > 0.3


@pytest.mark.parametrize("form", range(4))
def test_illumination_profile_dims_background_and_molecules_alike(form: int) -> None:
    world = hidden_world("illumination_profile", 0.6, form)
    assert world.light_map.mean() == pytest.approx(1.0)
    assert world.light_map.min() / world.light_map.max() == pytest.approx(1 - 0.85 * 0.36, abs=0.02)
    light = world.light_at(world.positions_px)
    mean = photophysics.expected_photons(world, np.random.default_rng(1)).mean(axis=1)
    np.testing.assert_allclose(mean / (world.photons_per_s * world.frame_s), light, rtol=1e-9)


def spot_of(world: World, frames: slice, seed: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Centre and covariance (y, x) of the mean image of a single bright spot, pixel width taken out."""
    world.positions_px = np.array([[32.0, 32.0]])
    world.background_photons = 0.0
    world.photons_per_s *= 20
    movie, _ = g._run(world, seed)
    electrons = movie[frames].mean(axis=0) - (199.5 + GAIN_ADU * 0.002)
    grid = np.mgrid[:64, :64].astype(float)
    weight = electrons * ((grid[0] - 32) ** 2 + (grid[1] - 32) ** 2 < 12**2)
    centre = (grid * weight).sum(axis=(1, 2)) / weight.sum()
    off = grid - centre[:, None, None]
    covariance = np.einsum("iyx,jyx,yx->ij", off, off, weight) / weight.sum() - np.eye(2) / 12
    return centre, covariance


@pytest.mark.parametrize("form", [0, 1, 2, 3])
def test_stage_drift_ends_where_the_truth_says(form: int) -> None:
    apply = g.EFFECTS["stage_drift"][0]
    ends = []
    for part in (slice(0, 3), slice(297, 300)):
        world = build(small(n_frames=300), 1, 0, np.random.default_rng(0))
        truth = apply(world, 1.0, form, np.random.default_rng(7))
        ends.append(spot_of(world, part)[0])
    moved = ends[1] - ends[0]
    np.testing.assert_allclose(moved, [truth["end_y_px"], truth["end_x_px"]], atol=0.2)
    if form in (0, 1, 2):
        assert np.hypot(*moved) == pytest.approx(4.0, abs=0.25)


def test_motion_inside_a_frame_blurs() -> None:
    world = build(small(n_frames=300), 1, 0, np.random.default_rng(0))
    moment = np.arange(300 * SUBSTEPS)
    world.shift_px = np.stack([np.sin(2 * np.pi * moment / SUBSTEPS), np.zeros(len(moment))], axis=1)
    _, covariance = spot_of(world, slice(0, 300))
    # one swing of amplitude 1 px per frame adds 1/2 along y and nothing along x
    assert covariance[0, 0] - covariance[1, 1] == pytest.approx(0.5, abs=0.08)


def test_focus_drift_widens_and_keeps_the_light() -> None:
    blind = case("focus_drift", 1.0, n=12)
    still = g.make(small(), seed=3, nuisance=0.0, n_molecules=12)
    assert blind.movie.mean() == pytest.approx(float(still.movie.mean()), rel=0.01)
    world = build(small(n_frames=300), 1, 0, np.random.default_rng(0))
    g.EFFECTS["focus_drift"][0](world, 1.0, 0, np.random.default_rng(7))
    _, late = spot_of(world, slice(280, 300))
    assert np.sqrt(np.trace(late) / 2) == pytest.approx(sigma_px(small()) * (1 + 0.6 * 290 / 300), rel=0.06)


def test_astigmatism_has_its_ratio_and_its_area() -> None:
    for form in (0, 1):
        world = build(small(n_frames=300), 1, 0, np.random.default_rng(0))
        g.EFFECTS["astigmatism"][0](world, 1.0, form, np.random.default_rng(7))
        _, covariance = spot_of(world, slice(0, 300))
        widths = np.sqrt(np.linalg.eigvalsh(covariance))
        assert widths[1] / widths[0] == pytest.approx(1.5, rel=0.04)
        assert widths[0] * widths[1] == pytest.approx(sigma_px(small()) ** 2, rel=0.04)


@pytest.mark.parametrize("form", [0, 2])
def test_diffusion_has_its_mean_squared_displacement(form: int) -> None:
    world = hidden_world("molecule_diffusion", 1.0, form, n=1000)
    path = world.wander_px[:, ::SUBSTEPS]
    lag = 30
    squared = ((path[:, 120 + lag] - path[:, 120]) ** 2).sum(axis=1)
    # both forms: 4 D t averaged over all molecules (the mobile half moves with twice the coefficient)
    expected = 4 * (3.5**2 / 12) * lag * world.frame_s
    assert squared.mean() == pytest.approx(expected, rel=5 * np.sqrt(5 / 1000))
    common = path.mean(axis=0)
    assert np.hypot(*common[-1]) < 0.7  # nobody pushes them together


def test_confined_diffusion_stays() -> None:
    path = hidden_world("molecule_diffusion", 1.0, 1, n=300).wander_px
    assert path[:, -1].std() == pytest.approx(1.75, rel=0.25)


def test_background_gradient_leaves_the_molecules_alone() -> None:
    for form in range(3):
        world = hidden_world("background_gradient", 1.0, form)
        mean = photophysics.expected_photons(world, np.random.default_rng(1))
        np.testing.assert_allclose(mean, world.photons_per_s * world.frame_s)
        assert np.ptp(world.background_map) == pytest.approx(1.2, rel=0.05)


# ---- strong: known results, camera ----------------------------------------------------------------------
@pytest.mark.parametrize("form", [0, 1])
@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_excess_noise_factor(form: int, strength: float) -> None:
    movie = case("em_excess_noise", strength, form=form).movie
    signal_e = 0.9 * 10 + 0.002
    variance = (2 - strength**1.5) * GAIN_ADU**2 * signal_e + (50 / 12) ** 2 + 1 / 12
    assert movie.var() == pytest.approx(variance, rel=5 * np.sqrt(4 / movie.size))
    assert movie.mean() == pytest.approx(199.5 + GAIN_ADU * signal_e, abs=5 * np.sqrt(variance / movie.size))


def test_clock_induced_charge_shows_in_the_dark() -> None:
    blind = case("clock_induced_charge", 1.0)
    charge = 0.4 + 0.002
    spread = np.sqrt((2 * GAIN_ADU**2 * charge + 17.4) / blind.dark.size)
    assert blind.dark.mean() == pytest.approx(199.5 + GAIN_ADU * charge, abs=5 * spread)
    serial = case("clock_induced_charge", 1.0, form=1)
    # E(gain**U) = (gain - 1)/ln gain
    expected = 199.5 + 0.002 * GAIN_ADU + 1.2 * (299 / np.log(300)) / 12
    assert serial.dark.mean() == pytest.approx(expected, abs=5 * np.sqrt(1e3 / blind.dark.size))


def test_pixel_gain_scales_mean_and_noise_of_a_pixel() -> None:
    movie = case("pixel_gain_variation", 1.0, n_frames=400).movie.astype(float)
    mean, variance = movie.mean(axis=0) - 199.5, movie.var(axis=0)
    real = np.sqrt(mean.var() - variance.mean() / 400) / mean.mean()
    assert real == pytest.approx(0.15, rel=5 / np.sqrt(2 * 64 * 64) + 0.03)
    slope = np.polyfit(np.log(mean.ravel()), np.log(variance.ravel()), 1)[0]
    assert slope == pytest.approx(2.0, abs=0.3)  # errors in the abscissa pull it down by some 5 %


def test_column_offset_is_in_the_dark_and_does_not_scale() -> None:
    for form in range(3):
        blind = case("column_offset", 1.0, form=form)
        pattern = np.median(blind.dark, axis=0) - 200.0
        assert pattern.std() == pytest.approx(50 / 12, rel=0.4)  # 64 columns: standard error 9 %, draws odd/even
        lit = blind.movie.mean(axis=0)
        gain = np.polyfit(pattern.mean(axis=0), lit.mean(axis=0), 1)[0]
        assert gain == pytest.approx(1.0, abs=0.35)  # column means of 120 frames x 64 pixels: error 1.2 ADU


@pytest.mark.parametrize("form", [0, 1, 2])
def test_row_noise_has_its_rms(form: int) -> None:
    blind = case("row_noise", 1.0, form=form)
    rows = blind.dark.mean(axis=2)
    own = (2 * GAIN_ADU**2 * 0.002 + (50 / 12) ** 2) / 64
    # 6400 rows; the rare form has kurtosis 30
    assert rows.var() - own == pytest.approx((50 / 12) ** 2, rel=5 * np.sqrt((30 if form == 2 else 3) / 6400))


def test_hot_pixels_are_narrow_still_and_dark_too() -> None:
    blind = case("hot_pixels", 1.0, n=0, n_frames=100)
    dark, lit = (np.argwhere(s.mean(axis=0) - np.median(s) > 1.2 * GAIN_ADU) for s in (blind.dark, blind.movie))
    assert len(dark) == parameters(blind)["n_pixels"]
    assert {tuple(p) for p in dark} <= {tuple(p) for p in lit}


@pytest.mark.parametrize("form", [0, 1, 2])
def test_saturation_bends_the_response(form: int) -> None:
    blind = case("detector_saturation", 0.9, form=form, background_photons_per_px=60.0)
    well = parameters(blind)["full_well_e"]
    rng = np.random.default_rng(0)
    electrons = rng.poisson(54.002, 400_000)
    analogue = rng.gamma(electrons, 300.0)
    expected = (
        analogue / (1 + analogue / well),
        np.minimum(analogue, well),
        well * np.tanh(analogue / well),
    )[form]
    assert blind.movie.mean() - 199.5 == pytest.approx(expected.mean() / 12, rel=0.005)
    assert expected.mean() < 0.9 * 54 * 300


def test_image_lag_correlates_neighbouring_frames() -> None:
    movie = case("image_lag", 1.0, n_frames=200).movie.astype(float)
    share = 0.15
    moving = movie - movie.mean(axis=0)
    correlation = (moving[1:] * moving[:-1]).mean() / (moving**2).mean()
    read = (50 / 12) ** 2 + 1 / 12
    variance = 2 * GAIN_ADU**2 * 9.002
    expected = variance * share * (1 - share) / (variance * (share**2 + (1 - share) ** 2) + read)
    # taking off the mean of 200 frames costs 1/200
    assert correlation == pytest.approx(expected - 1 / 200, abs=5 / np.sqrt(movie.size) + 0.001)
    assert movie.mean() == pytest.approx(199.5 + GAIN_ADU * 9.002, abs=0.6)


def test_baseline_drift_moves_the_mean_and_not_the_variance() -> None:
    blind = case("baseline_drift", 1.0, n_frames=200)
    change = parameters(blind)["change_adu"]
    assert abs(change) == pytest.approx(10.0)
    movie = blind.movie.astype(float)
    se = np.sqrt(movie.var() / (50 * 64 * 64))
    moved = movie[-50:].mean() - movie[:50].mean()
    assert moved == pytest.approx(0.75 * change, abs=5 * np.sqrt(2) * se)
    assert movie[-50:].var() / movie[:50].var() == pytest.approx(1.0, abs=5 * np.sqrt(8 / (50 * 64 * 64)))
    dark = blind.dark.astype(float)
    # 100 dark frames are half a movie long, and end where the movie begins
    assert dark[-25:].mean() - dark[:25].mean() == pytest.approx(0.375 * change, abs=0.3)


def test_cosmic_rays_hit_as_often_as_said_and_never_twice() -> None:
    blind = case("cosmic_rays", 1.0, n_frames=400)
    bright = blind.movie > 200 + GAIN_ADU * 75  # fifteen standard deviations above the background
    expected = 0.3 * 400 * stats.norm.sf((np.log(66) - np.log(600)) / 0.8)
    assert bright.sum() == pytest.approx(expected, abs=5 * np.sqrt(expected))
    assert bright.sum(axis=0).max() <= 2


# ---- off the catalogue ----------------------------------------------------------------------------------
def off(kind: str, strength: float = 0.8, n: int = 0, **model: float) -> g.BlindMovie:
    return g.off_catalogue(small(**model), kind, 3, strength=strength, nuisance=0.0, n_molecules=n)


def test_off_catalogue_disturbances_do_what_they_say() -> None:
    even_odd = off("even_odd_frames").movie.mean(axis=(1, 2)) - 199.5
    assert even_odd[::2].mean() / even_odd[1::2].mean() == pytest.approx(1.096 / 0.904, rel=0.01)
    shutter = off("shutter_event")
    frame_mean = shutter.movie.mean(axis=(1, 2)) - 199.5
    closed = np.flatnonzero(frame_mean < 0.6 * np.median(frame_mean))
    assert set(closed) >= set(shutter.truth["off_catalogue"][0]["parameters"]["start_frames"])
    smooth = off("on_camera_smoothing").dark.astype(float)
    assert np.corrcoef(smooth[:, :, 1:].ravel(), smooth[:, :, :-1].ravel())[0, 1] > 0.2
    coarse = off("quantisation")
    step = coarse.truth["off_catalogue"][0]["parameters"]["step_adu"]
    assert step > 8 and (coarse.movie % step == 0).all() and (coarse.dark % step == 0).all()
    repeated = off("duplicated_frames").movie
    same = (np.diff(repeated.astype(int), axis=0) == 0).all(axis=(1, 2))
    assert 1 <= same.sum() <= 35  # binomial(119, 0.12)


def test_a_disturbance_beside_effects_is_the_one_that_it_is_alone() -> None:
    model = g.base_model("emccd_short")
    alone = g.make(model, effects=[("row_noise", 0.5)], seed=3)
    both = g.make(model, effects=[("row_noise", 0.5)], beside=[("duplicated_frames", 0.5)], seed=3)
    only = g.off_catalogue(model, "duplicated_frames", 3)
    assert both.truth["effects"] == alone.truth["effects"]
    assert both.truth["off_catalogue"] == only.truth["off_catalogue"] != []
    kept = (both.movie == alone.movie).all(axis=(1, 2))
    repeats = (np.diff(only.movie.astype(int), axis=0) == 0).all(axis=(1, 2))
    np.testing.assert_array_equal(kept[1:], ~repeats)  # the others are repeats of the frame before
    assert kept[0] and repeats.any()


def test_further_bases_have_their_light_and_their_bleaching() -> None:
    def share_left(name: str) -> float:
        model = g.base_model(name)
        movie_s = model["acquisition"]["n_frames"] * model["acquisition"]["frame_length_s"]
        bleach = excitation_rate_per_s(model) / model["fluorophore"]["cycles_before_bleaching"]
        return float(np.exp(-bleach * movie_s))

    assert share_left("emccd_bleach") == share_left("cmos_bleach") == pytest.approx(share_left("ccd_bleach"))
    assert {g.base_model(name)["camera"]["type"] for name in g.BASE_NAMES} == {"EMCCD", "CCD", "CMOS"}
    sides = [g.base_model(name)["acquisition"]["shape_px"][0] for name in g.BASE_NAMES]
    assert (min(sides), max(sides)) == (64, 256)
    lit_s, excited_per_s = {}, {name: excitation_rate_per_s(g.base_model(name)) for name in PROTOCOLS}
    for name, way_out in zip(PROTOCOLS, ("isc_ratio", "isc_ratio", "cycles_before_bleaching"), strict=True):
        chance = g.base_model(name)["fluorophore"][way_out]
        lit_s[name] = 1 / (excited_per_s[name] * (chance if way_out == "isc_ratio" else 1 / chance))
    assert list(lit_s.values()) == pytest.approx([0.2, 0.1, 0.29], rel=0.03)
    g.base_model("cmos_dim")["camera"]["em_gain"] = 3
    assert "em_gain" not in g.base_model("cmos_dim")["camera"]


def test_off_catalogue_motion_and_levels() -> None:
    world = build(small(), 50, 0, np.random.default_rng(0))
    found = g.OFF_CATALOGUE["thermal_expansion"](world, 0.8, np.random.default_rng(1))
    moved = world.wander_px[:, -1]
    slope = np.polyfit(world.positions_px[:, 0], moved[:, 0], 1)[0]
    assert slope == pytest.approx(found["relative_expansion"], rel=0.01)
    found = g.OFF_CATALOGUE["vibration"](world, 0.8, np.random.default_rng(1))
    assert np.hypot(*world.shift_px.T).max() == pytest.approx(found["amplitude_px"], rel=0.1)
    found = g.OFF_CATALOGUE["level_switching"](world, 0.8, np.random.default_rng(1))
    assert set(np.unique(world.level)) == {found["level_ratio"], 1.0}


# ---- command line ---------------------------------------------------------------------------------------
def test_command_line_keeps_the_truth_apart(tmp_path: Path) -> None:
    import tifffile

    model = tmp_path / "short.json"
    model.write_text(json.dumps(g.base_model("emccd_short")))
    out = tmp_path / "case"
    words = f"--effect row_noise --strength 0.4 --seed 7 --model {model} --out {out}".split()
    assert g.main(words) == 0
    assert sorted(p.name for p in out.iterdir()) == ["dark.tif", "model.json", "movie.tif"]
    truth = json.loads((tmp_path / "case-truth" / "truth.json").read_text())
    assert truth["effects"][0]["kind"] == "row_noise" and truth["effects"][0]["strength"] == 0.4
    assert "row_noise" not in (out / "model.json").read_text()
    same = g.make(g.base_model("emccd_short"), effects=[("row_noise", 0.4)], seed=7)
    np.testing.assert_array_equal(tifffile.imread(out / "movie.tif"), same.movie)
    np.testing.assert_array_equal(tifffile.imread(out / "dark.tif"), same.dark)


def test_command_line_refuses_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert g.main(f"--effect nonsense --seed 1 --out {tmp_path / 'x'}".split()) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()
