"""Laws of the photophysics effects at strong values; tolerances of four standard errors (6e-5 each)."""

import numpy as np
import pytest
from scipy import stats

from napari_mufasa import preset, simulate_emission

from .helpers import effect, plain, scene_of

K01 = 6724.90


def on_until(counts):
    """Last frame with light, +1; 0 for a molecule never seen."""
    on = counts > 0
    return np.where(on.any(axis=1), on.shape[1] - on[:, ::-1].argmax(axis=1), 0)


def check_share(found, expected, n, slack=0.0):
    assert found == pytest.approx(expected, abs=4 * np.sqrt(expected * (1 - expected) / n) + slack)


@pytest.mark.parametrize(
    ("kind", "form", "off", "dark"),
    [
        ("triplet_blinking", "exponential", 25.0, 0.04),
        ("triplet_blinking", "two_exponential", 25.0, 0.04),
        ("long_dark_state", "exponential", 5.0, 0.3),
        ("long_dark_state", "power_law", 5.0, 0.3),
    ],
)
@pytest.mark.parametrize("protocol", ["FF", "STORM"])
def test_dark_fraction(kind, form, off, dark, protocol):
    """In the steady state the dark share is off·t/(1 + off·t) from the first frame on, whatever the form."""
    added = effect(kind, form=form, off_rate_per_s=off, dark_time_s=dark, start="equilibrium")
    values = {"protocol": protocol, "fluorophore.isc_ratio": None}
    counts = simulate_emission(plain(n_frames=100, **values).with_effects(added), 3000, seed=1)
    share = 1 - counts.mean(axis=1) / (K01 * 0.01)
    expected = off * dark / (1 + off * dark)
    # Every visit to the dark costs a photon: brightness is O(off/k01) lower.
    assert share.mean() == pytest.approx(expected, abs=4 * share.std() / np.sqrt(3000) + off / K01)
    for frames in (slice(0, 1), slice(99, 100)):
        part = 1 - counts[:, frames].mean(axis=1) / (K01 * 0.01)
        assert part.mean() == pytest.approx(expected, abs=4 * part.std() / np.sqrt(3000) + off / K01)


@pytest.mark.parametrize("kind", ["triplet_blinking", "long_dark_state"])
def test_a_bright_start_relaxes_to_the_dark_fraction(kind):
    added = effect(kind, off_rate_per_s=4.0, dark_time_s=0.1, start="bright")
    counts = simulate_emission(plain(n_frames=60).with_effects(added), 4000, seed=2) / (K01 * 0.01)
    time = (np.arange(60) + 0.5) * 0.01
    bright = (1 + 0.4 * np.exp(-(4.0 + 10.0) * time)) / 1.4
    # 60 frames, |z| > 4.5: overall 4e-4.
    error = counts.std(axis=0) / np.sqrt(4000)
    assert np.all(np.abs(counts.mean(axis=0) - bright) < 4.5 * error + 2e-3)


def test_dark_dwell_times_are_exponential():
    """A start in the dark state lasts t_off: first light of those that start dark."""
    added = effect("triplet_blinking", off_rate_per_s=50.0, dark_time_s=0.1, start="equilibrium")
    counts = simulate_emission(plain(n_frames=1000, frame_length_s=1e-3).with_effects(added), 3000, seed=3)
    first = (counts > 0).argmax(axis=1)
    jitter = np.random.default_rng(1).random(3000)
    waits = (first[first > 2] - 3 + jitter[first > 2]) * 1e-3  # no memory: beyond three frames
    assert len(waits) > 2000
    assert stats.kstest(waits, "expon", args=(0, 0.1)).pvalue > 1e-4


@pytest.mark.parametrize("kind", ["triplet_blinking", "long_dark_state"])
def test_forms_keep_the_mean_and_spread_the_dwell_times(kind):
    second = {"triplet_blinking": "two_exponential", "long_dark_state": "power_law"}[kind]
    means, spreads = [], []
    for form in ("exponential", second):
        chain = scene_of(plain().with_effects(effect(kind, form=form, dark_time_s=0.2, off_rate_per_s=3.0))).chain
        back = {t.source: t.rate_per_s for t in chain.transitions if t.target == "S0" and t.source != "S1"}
        rate_in = np.array([sum(t.rate_per_s for t in chain.transitions if t.target == s) for s in back])
        weight, dwell = rate_in / rate_in.sum(), 1 / np.array(list(back.values()))
        means.append((weight * dwell).sum())
        spreads.append((weight * 2 * dwell**2).sum() / means[-1] ** 2 - 1)
    assert means == pytest.approx([0.2, 0.2], rel=1e-2)
    assert spreads[0] == pytest.approx(1) and spreads[1] > 1.5


def test_molecules_that_are_not_activated_stay_so():
    """Blinking in PALM does not activate anyone."""
    palm = preset("PALM").with_values({"acquisition.n_frames": 50, "excitation.activation_rate_per_s": 0.0})
    blinking = palm.with_effects(effect("triplet_blinking", off_rate_per_s=20.0, dark_time_s=0.05))
    assert not simulate_emission(blinking, 300, seed=4).any()


def test_blinking_comes_on_top_of_a_triplet_the_protocol_has():
    """STORM with its own T1 and the effect's dark state: two states, T1 left at its own rate."""
    values = {"fluorophore.triplet_decay_rate_per_s": 30.0, "acquisition.n_frames": 100}
    storm = preset("STORM").with_values(values)
    scene = scene_of(storm.with_effects(effect("triplet_blinking", dark_time_s=0.5)))
    back = sorted(t.rate_per_s for t in scene.chain.transitions if t.target == "S0" and t.source != "S1")
    assert back == pytest.approx([2.0, 30.0])
    assert scene.chain.start["T1"] == 1.0
    assert len(scene.chain.states) == 5


@pytest.mark.parametrize("rate", [0.5, 3.0])
def test_photobleaching_survival_is_exponential(rate):
    counts = simulate_emission(
        plain(n_frames=100).with_effects(effect("photobleaching", rate_per_s=rate)), 5000, seed=5
    )
    for frame in (10, 50, 99):
        alive = np.mean(on_until(counts) > frame)
        # Alive at the start of the frame and long enough in it to be seen (1/k01 = 0.15 ms).
        check_share(alive, np.exp(-rate * (frame * 0.01 + 0.15e-3)), 5000)


def test_two_populations_bleach_at_their_own_rates_and_never_mix():
    added = effect("photobleaching", rate_per_s=2.0, fast_fraction=0.5, rate_ratio=9.0, form="two_populations")
    slow = 2.0 / (1 + 0.5 * 8)
    blink = effect("triplet_blinking", off_rate_per_s=40.0, dark_time_s=0.02)
    for effects in ((added,), (added, blink), (blink, added)):
        counts = simulate_emission(plain(n_frames=200).with_effects(*effects), 5000, seed=6)
        bright = 1.0 if len(effects) == 1 else 1 / 1.8  # bleaching happens from the bright state only
        alive = on_until(counts)
        for frame in (20, 80, 150):
            time = frame * 0.01
            if len(effects) == 1:
                expected = 0.5 * np.exp(-9 * slow * time) + 0.5 * np.exp(-slow * time)
                check_share(np.mean(alive > frame), expected, 5000, slack=2e-3)
            else:
                # Blinking is fast against bleaching: survival at rate × bright share, to 3 %.
                expected = 0.5 * np.exp(-9 * slow * bright * time) + 0.5 * np.exp(-slow * bright * time)
                check_share(np.mean(alive > frame), expected, 5000, slack=0.03)
        # Mixed kinds would all bleach at the mean rate: 0.5 % left after 1.5 s of light instead of 20 %.


def test_bleaching_adds_to_the_model_s_own():
    base = plain(n_frames=100, **{"fluorophore.cycles_before_bleaching": K01 / 1.0})  # 1 per s
    counts = simulate_emission(base.with_effects(effect("photobleaching", rate_per_s=2.0)), 5000, seed=7)
    check_share(np.mean(on_until(counts) > 50), np.exp(-3.0 * 0.50015), 5000, slack=1e-3)


@pytest.mark.parametrize(
    ("form", "law"),
    [
        ("exponential", lambda t: 1 - np.exp(-3 * t)),
        ("two_step", lambda t: 1 - np.exp(-6 * t) * (1 + 6 * t)),
        ("steady", lambda t: stats.gamma.cdf(t, np.arange(1, 33), scale=1 / 49.5).mean()),  # all stages alike
    ],
)
@pytest.mark.parametrize("others", [(), ("two_populations",)])
def test_delayed_activation_first_seen(form, law, others):
    effects = [effect("delayed_activation", fraction=0.7, activation_rate_per_s=3.0, form=form)]
    if others:  # a start in several states is kept
        effects.insert(0, effect("photobleaching", rate_per_s=1e-3, form="two_populations"))
    counts = simulate_emission(plain(n_frames=150).with_effects(*effects), 5000, seed=8)
    on = counts > 0
    first = np.where(on.any(axis=1), on.argmax(axis=1), 10**6)
    check_share(np.mean(first == 0), 0.3 + 0.7 * law(0.01 - 1.5e-4), 5000, slack=1e-3)
    for frame in (20, 60, 149):
        check_share(np.mean(first <= frame), 0.3 + 0.7 * law((frame + 1) * 0.01 - 1.5e-4), 5000, slack=1e-3)


def test_molecules_that_are_activated_steadily_come_at_a_constant_rate():
    """From a fifth to seven tenths of twice the mean time as many in each tenth, to 2 % (32 stages are not infinitely
    many); those of exponential ones would become fewer by a factor of 2.7. 20 000 molecules."""
    added = effect("delayed_activation", fraction=1.0, activation_rate_per_s=1.0, form="steady")
    on = simulate_emission(plain(n_frames=180).with_effects(added), 20_000, seed=12) > 0
    came = np.histogram(np.where(on.any(axis=1), on.argmax(axis=1), 10**6), bins=np.arange(40, 141, 20))[0]
    constant = 20_000 * 0.2 / 2 * 33 / 32  # in 0.2 s, until 32/33 of twice the mean time
    np.testing.assert_allclose(came, constant, rtol=0.02 + 4 / np.sqrt(constant))


def test_activated_molecules_are_what_they_would_have_been():
    """Two kinds start half and half; those activated later are half and half too."""
    effects = (
        effect("photobleaching", rate_per_s=2.0, fast_fraction=0.5, rate_ratio=20.0, form="two_populations"),
        effect("delayed_activation", fraction=1.0, activation_rate_per_s=200.0),
    )
    counts = simulate_emission(plain(n_frames=100).with_effects(*effects), 4000, seed=9)
    slow = 2.0 / (1 + 0.5 * 19)
    check_share(np.mean(on_until(counts) > 90), 0.5 * np.exp(-slow * 0.9), 4000, slack=5e-3)


@pytest.mark.parametrize(
    "other",
    [
        effect("triplet_blinking", off_rate_per_s=12.5, dark_time_s=0.08, start="equilibrium"),
        effect("level_switching", to_low_per_s=4.0, to_full_per_s=4.0, level=0.3),
    ],
)
def test_activated_molecules_are_in_the_equilibrium_that_others_start_in(other):
    """Half of them dark, or low: as bright in the first frames after activation as later on."""
    n, frames = 4000, 300
    delayed = effect("delayed_activation", fraction=1.0, activation_rate_per_s=300.0)  # all within the first frames
    counts = simulate_emission(plain(n_frames=frames).with_effects(delayed, other), n, seed=5).astype(float)
    soon, later = counts[:, 3:8].mean(axis=1), counts[:, -150:].mean()
    assert soon.mean() == pytest.approx(later, abs=4 * soon.std() / np.sqrt(n) + 0.01 * later)


@pytest.mark.parametrize("form", ["lognormal", "gamma", "two_levels", "orientations"])
@pytest.mark.parametrize("spread", [0.2, 0.7])
def test_brightness_spread_is_the_coefficient_of_variation(form, spread):
    positions = np.zeros((20_000, 2))
    model = plain(n_frames=1).with_effects(effect("brightness_heterogeneity", spread=spread, form=form))
    brightness = scene_of(model, positions).brightness
    assert brightness.min() > 0
    assert brightness.mean() == pytest.approx(1, abs=4 * spread / np.sqrt(20_000))
    moment4 = np.mean((brightness - 1) ** 4)
    assert brightness.var() == pytest.approx(spread**2, abs=4 * np.sqrt(moment4 / 20_000) + 1e-9)


def test_fixed_dipoles_absorb_as_their_directions_say():
    """cos² of the angle to the field of a random direction u is below x for |u| < √x; sin², of that to the axis, below
    1 − x for |u| > √x. In a larger spread than the field's polarisation makes there are no molecules."""
    n = 20_000
    for spread, cdf in (
        (1 / np.sqrt(5), lambda b: 1 - np.sqrt(1 - np.clip(b / 1.5, 0, 1))),  # factor 1.5 sin², mean 1
        (2 / np.sqrt(5), lambda b: np.sqrt(np.clip(b / 3, 0, 1))),  # factor 3 cos²
        (2.0, lambda b: np.sqrt(np.clip(b / 3, 0, 1))),
    ):
        model = plain(n_frames=1).with_effects(effect("brightness_heterogeneity", spread=spread, form="orientations"))
        brightness = scene_of(model, np.zeros((n, 2))).brightness
        assert stats.kstest(brightness, cdf).pvalue > 1e-4


def test_brightness_stays_with_its_molecule():
    model = plain(n_frames=30, shape=(24, 24)).with_effects(effect("brightness_heterogeneity", spread=0.6))
    from napari_mufasa import simulate

    result = simulate(model, np.array([[6.0, 6.0], [17.0, 17.0]]), seed=10)
    levels = result.optical[:, 4:9, 4:9].sum(axis=(1, 2)) - 25 * 20
    ratio = levels / result.emission[0]
    assert ratio.std() / ratio.mean() < 0.02


@pytest.mark.parametrize(
    ("form", "law"), [("dimers", {1: 0.4, 2: 0.6}), ("oligomers", {1: 0.4, 2: 0.2, 3: 0.2, 4: 0.2})]
)
def test_oligomers(form, law):
    """Copies at one place, each with its own photophysics: counts of emitters per spot."""
    positions = np.arange(8000, dtype=float).reshape(-1, 2)
    scene = scene_of(plain(n_frames=2).with_effects(effect("multiple_emitters", fraction=0.6, form=form)), positions)
    copies = np.bincount((scene.positions_px[:, 0] // 2).astype(int), minlength=4000)
    assert len(scene.brightness) == copies.sum()
    for n, share in law.items():
        check_share(np.mean(copies == n), share, 4000)


def test_emitters_of_a_spot_bleach_one_by_one():
    effects = (effect("multiple_emitters", fraction=1.0), effect("photobleaching", rate_per_s=5.0))
    counts = simulate_emission(plain(n_frames=40).with_effects(*effects), 500, seed=11)
    assert len(counts) == 1000
    first, second = on_until(counts[::2]), on_until(counts[1::2])
    assert abs(np.corrcoef(first, second)[0, 1]) < 4 / np.sqrt(500)


def test_a_walk_is_shared_by_the_emitters_of_a_spot():
    effects = (effect("molecule_diffusion"), effect("multiple_emitters", fraction=1.0))
    scene = scene_of(plain().with_effects(*effects), np.zeros((5, 2)))
    np.testing.assert_array_equal(scene.walk_px[:, ::2], scene.walk_px[:, 1::2])


def test_emitters_that_never_go_out_are_a_spread_of_brightness_and_nothing_else():
    """The light of two has the mean and the variance of one that is twice as bright: seen for twice as long."""
    several, bright = effect("multiple_emitters", fraction=1.0), plain(n_frames=400)
    pairs = simulate_emission(bright.with_effects(several), 50, seed=5).reshape(50, 2, -1).sum(axis=1)
    ones = simulate_emission(plain(n_frames=400, frame_length_s=0.02), 50, seed=6)
    n = pairs.size
    assert abs(pairs.mean() - ones.mean()) < 4 * np.sqrt(2 * ones.mean() / n)
    assert pairs.var() / ones.var() == pytest.approx(1, abs=4 * np.sqrt(4 / n))
    assert several.same_as(bright, []) == ("brightness_heterogeneity",)
    assert several.same_as(bright, ["photobleaching"]) == ()
    assert several.same_as(bright.with_values({"fluorophore.cycles_before_bleaching": 1e5}), []) == ()
