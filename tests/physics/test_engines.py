"""The fast engine against the exact one, in distribution, on all four protocols (docs/photophysics.md).

All comparisons are between simulations of different seeds. Kolmogorov-Smirnov tests on whole numbers are
conservative, so the false-alarm rates stated are upper bounds. Seeds are fixed.
"""

import warnings

import numpy as np
import pytest
from scipy import stats

from napari_mufasa import MufasaError, preset, simulate_emission
from napari_mufasa.chance.streams import Streams
from napari_mufasa.chance.variates import exponential, stream, uniform
from napari_mufasa.photophysics.chain import Chain, Transition
from napari_mufasa.photophysics.engines import Exposure, merge_bright_states, simulate_photons
from napari_mufasa.photophysics.protocols import protocol_chain

OVERALL = 1e-3  # false alarms of the whole comparison of the engines
N = 6000

# The presets, with bleaching and activation hurried so that every transition happens often in a short movie.
MODELS = {
    "PALM": {"fluorophore.cycles_before_bleaching": 4000, "excitation.activation_rate_per_s": 4.0},
    "STORM": {"fluorophore.cycles_before_bleaching": 4000, "fluorophore.triplet_decay_rate_per_s": 12.0},
    "FF": {},
    "Blinking": {"fluorophore.triplet_decay_rate_per_s": 6.0, "fluorophore.cycles_before_bleaching": 5000},
}


def model_of(name, n_frames=60):
    return preset(name).with_values(MODELS[name] | {"acquisition.n_frames": n_frames})


@pytest.fixture(scope="module")
def both():
    return {
        name: tuple(simulate_emission(model_of(name), N, seed=s, engine=e) for e, s in (("fast", 1), ("exact", 2)))
        for name in MODELS
    }


def gaps(counts):
    """Lengths in frames of the dark stretches between two bright frames; one per molecule (the first)."""
    found = []
    for row in counts > 0:
        edges = np.flatnonzero(np.diff(np.concatenate(([0], row.view(np.int8), [0]))))
        starts, ends = edges[::2], edges[1::2]
        if len(starts) > 1:
            found.append(starts[1] - ends[0])
    return np.array(found)


def last_on(counts):
    on = counts > 0
    return np.where(on.any(axis=1), on.shape[1] - on[:, ::-1].argmax(axis=1), 0)


STATISTICS = {
    "total photons": lambda c: c.sum(axis=1),
    "frames with light": lambda c: (c > 0).sum(axis=1),
    "photons in frame 0": lambda c: c[:, 0],
    "photons in frame 25": lambda c: c[:, 25],
    "first frame with light": lambda c: np.where((c > 0).any(axis=1), (c > 0).argmax(axis=1), c.shape[1]),
    "last frame with light": last_on,
}


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("statistic", STATISTICS)
def test_engines_agree_in_distribution(both, name, statistic):
    """24 two-sample KS tests (one number per molecule, so samples are independent), overall 1e-3."""
    fast, exact = (STATISTICS[statistic](counts) for counts in both[name])
    assert stats.ks_2samp(fast, exact).pvalue > OVERALL / (len(MODELS) * len(STATISTICS))


@pytest.mark.parametrize("name", ["STORM", "Blinking"])
def test_engines_agree_in_dark_dwell_times(both, name):
    fast, exact = (gaps(counts) for counts in both[name])
    assert min(len(fast), len(exact)) > 1500
    assert stats.ks_2samp(fast, exact).pvalue > OVERALL / 2


def test_the_comparison_sees_a_difference_of_a_fifth(both):
    """The comparison can fail: a fifth fewer cycles or a sixth faster return is seen somewhere."""
    for name, change in (
        ("FF", {"fluorophore.cycles_before_bleaching": 4000}),
        ("STORM", {"fluorophore.triplet_decay_rate_per_s": 14.0}),
    ):
        model = model_of(name).with_values(change)
        other = simulate_emission(model, N, seed=4, engine="fast")
        pvalues = [stats.ks_2samp(s(other), s(both[name][1])).pvalue for s in STATISTICS.values()]
        assert min(pvalues) < OVERALL / 24


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_poisson_limit(engine):
    """Source note 2: k01 ≪ k10 and no dark state → Poisson counts of mean k01 Δt, independent between frames."""
    values = {"fluorophore.cycles_before_bleaching": None, "acquisition.n_frames": 20}
    counts = simulate_emission(preset("FF").with_values(values), 1500, seed=6, engine=engine)
    mu = 67.2490
    # Chi-square of the histogram (bins of expected ≥ 30), false alarm 1e-4 each.
    grid = np.arange(0, 200)
    expected = stats.poisson.pmf(grid, mu) * counts.size
    observed = np.bincount(counts.ravel(), minlength=200)[:200]
    use = expected >= 30
    e, o = np.append(expected[use], expected[~use].sum()), np.append(observed[use], observed[~use].sum())
    e *= o.sum() / e.sum()
    assert stats.chisquare(o, e).pvalue > 1e-4
    centred = counts - mu
    lag_1 = (centred[:, 1:] * centred[:, :-1]).mean() / mu
    assert abs(lag_1) < 4 / np.sqrt(counts[:, 1:].size)  # |z| > 4: 6e-5


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_photons_until_bleaching_are_geometric(engine):
    """Each cycle ends in a photon with QY·k10/(k10+k1B): mean N_c·QY, P(N ≥ n) = q^n."""
    model = preset("FF").with_values(
        {
            "fluorophore.cycles_before_bleaching": 200,
            "fluorophore.quantum_yield": 0.6,
            "acquisition.n_frames": 4,
            "acquisition.frame_length_s": 0.2,  # 0.8 s: 27 bleaching times
        }
    )
    totals = simulate_emission(model, 4000, seed=7, engine=engine).sum(axis=1)
    mean = 200 * 0.6  # k10/k1B = N_c relaxations per bleaching
    assert totals.mean() == pytest.approx(mean, abs=4 * mean / np.sqrt(4000))  # |z| > 4: 6e-5
    q = mean / (1 + mean)
    # KS against the geometric law; discreteness makes it conservative; false alarm ≤ 1e-4.
    steps = np.sort(totals)
    empirical = np.searchsorted(steps, np.arange(2000), side="right") / 4000
    distance = np.abs(empirical - (1 - q ** (np.arange(2000) + 1))).max()
    assert stats.kstwobign.sf(distance * np.sqrt(4000)) > 1e-4


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_no_photon_is_lost_at_frame_edges(engine):
    """Forty short frames hold what one long frame holds."""
    base = preset("Blinking").with_values({"fluorophore.triplet_decay_rate_per_s": 20.0})
    short = base.with_values({"acquisition.n_frames": 40, "acquisition.frame_length_s": 0.002})
    long = base.with_values({"acquisition.n_frames": 1, "acquisition.frame_length_s": 0.08})
    a = simulate_emission(short, 4000, seed=8, engine=engine).sum(axis=1)
    b = simulate_emission(long, 4000, seed=9, engine=engine).sum(axis=1)
    assert stats.ks_2samp(a, b).pvalue > 1e-4


def test_dead_time_takes_its_share_of_the_light():
    """Exposure 4 ms of every 10 ms: 40 % of the photons, and bleaching goes on in the dark."""
    base = preset("FF").with_values({"fluorophore.cycles_before_bleaching": 2000, "acquisition.n_frames": 200})
    dead = base.with_values({"acquisition.frame_length_s": 0.004, "acquisition.frame_interval_s": 0.01})
    photons = simulate_emission(dead, 4000, seed=10).sum(axis=1)
    whole = simulate_emission(base, 4000, seed=11).sum(axis=1)
    assert photons.mean() / whole.mean() == pytest.approx(0.4, rel=4 * np.sqrt(2 / 4000))  # |z| > 4: 6e-5


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_light_in_time_and_per_molecule(engine):
    """Counts follow light(frame) × drive(molecule)."""
    chain = Chain(
        ("S0", "S1"),
        (Transition("S0", "S1", 5000.0, driven=True), Transition("S1", "S0", 1e8, photon_probability=1.0)),
        {"S0": 1.0},
    )
    drive = np.repeat([0.5, 2.0], 1000)
    light = np.array([0.0, 1.0, 0.25, 3.0])
    counts = simulate_photons(chain, drive, Exposure(0.01, 0.0, light), Streams(12), engine)[0]
    for half, level in ((slice(0, 1000), 0.5), (slice(1000, 2000), 2.0)):
        mean = 50 * level * light
        np.testing.assert_array_less(np.abs(counts[half].mean(axis=0) - mean), 4.3 * np.sqrt(mean / 1000) + 1e-2)


def bright(power):
    """A fluorophore slow enough (τ 50 µs) that k01/k10 is large in ordinary light."""
    return preset("FF").with_values(
        {
            "fluorophore.lifetime_s": 5e-5,
            "fluorophore.cycles_before_bleaching": 3000,
            "excitation.power_density_w_per_cm2": power,
            "acquisition.n_frames": 30,
        }
    )


def test_fast_falls_back_to_exact_where_the_separation_fails():
    with pytest.warns(UserWarning, match=r"k01/k10 exceeds 0\.01; running the exact engine"):
        fast = simulate_emission(bright(2), 300, seed=13, engine="fast")
    np.testing.assert_array_equal(fast, simulate_emission(bright(2), 300, seed=13, engine="exact"))


def test_only_molecules_too_bright_for_it_leave_the_fast_engine():
    """In light of 0.2 … 2 of that where k01/k10 is 0.0134: each molecule's photons are those that it has alone, by one
    engine up to 0.01, by the other beyond."""
    chain, drive = protocol_chain(bright(0.08)), np.linspace(0.2, 2.0, 40)
    exposure = Exposure(0.01, 0.0, np.ones(30))
    with (
        pytest.warns(UserWarning, match=r"k01/k10 exceeds 0\.01; running the exact engine for the molecules"),
        pytest.warns(UserWarning, match="all noise of emission is kept"),
    ):
        photons, expected = simulate_photons(chain, drive, exposure, Streams(15), "fast", with_expected=True)
    exact, _ = simulate_photons(chain, drive, exposure, Streams(15), "exact")
    merged = merge_bright_states(chain)
    beyond = drive > merged.brightest_light
    assert 5 < beyond.sum() < 35
    assert merged.brightest_light == pytest.approx(0.01 * (2e4 + 2e4 / 3000) / (6724.90 * 0.04), rel=1e-4)
    np.testing.assert_array_equal(photons[beyond], exact[beyond])
    np.testing.assert_array_equal(expected[beyond], exact[beyond])
    weak = np.where(beyond, 0.0, drive)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        fast, means = simulate_photons(chain, weak, exposure, Streams(15), "fast", with_expected=True)
    np.testing.assert_array_equal(photons[~beyond], fast[~beyond])
    np.testing.assert_array_equal(expected[~beyond], means[~beyond])
    assert not np.array_equal(photons[~beyond], exact[~beyond])


def test_exact_counts_are_sub_poissonian_as_a_renewal_process():
    """Fano factor 1 − 2 k01 k10/(k01+k10)² (docs/photophysics.md): alternating exponential waits."""
    model = bright(2).with_values(
        {"fluorophore.cycles_before_bleaching": None, "acquisition.frame_length_s": 0.05, "acquisition.n_frames": 40}
    )
    counts = simulate_emission(model, 400, seed=14, engine="exact")
    k01, k10 = 6724.90, 2e4
    mean = 0.05 * k01 * k10 / (k01 + k10)
    fano = counts[:, 1:].var() / counts[:, 1:].mean()
    n = counts[:, 1:].size
    assert counts[:, 1:].mean() == pytest.approx(mean, abs=4 * np.sqrt(mean / n))
    assert fano == pytest.approx(1 - 2 * k01 * k10 / (k01 + k10) ** 2, abs=4 * np.sqrt(2 / n))  # |z| > 4: 6e-5


def test_frames_of_a_few_lifetimes_fall_back_to_exact():
    model = preset("FF").with_values({"acquisition.frame_length_s": 5e-8, "acquisition.n_frames": 5})
    with pytest.warns(UserWarning, match="fewer than 100 lifetimes; running the exact engine"):
        simulate_emission(model, 3, seed=1)


def test_no_warning_where_the_separation_holds():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for name in ("PALM", "STORM", "FF", "Blinking", "EGFP", "Alexa647-STORM"):
            simulate_emission(preset(name), 2, seed=1)


def test_unknown_engine_is_refused():
    with pytest.raises(MufasaError, match="choose one of fast, exact"):
        simulate_emission(preset("FF"), 2, engine="turbo")


@pytest.mark.parametrize("n", [-1, 2.5, True, "10"])
def test_wrong_number_of_molecules_is_refused(n):
    with pytest.raises(MufasaError, match="n_molecules"):
        simulate_emission(preset("FF"), n)


def test_a_molecule_without_light_stays_dark():
    model = preset("FF").with_values({"excitation.power_density_w_per_cm2": 0})
    assert not simulate_emission(model, 20, seed=1).any()
    assert not simulate_emission(model, 20, seed=1, engine="exact").any()


def drawn(variate, random):
    value, random = variate(np.uint64(random))
    return value, np.uint64(random)


def frame_by_frame(chain, drive, exposure, streams):
    """The jump process written out: photons at jumps, and the time in each state."""
    total_rates = [chain.generator(0.0), chain.generator(1.0) - chain.generator(0.0)]
    n = len(chain.states)
    photons, stays = (
        np.zeros((len(drive), exposure.light.size), np.int64),
        np.zeros((len(drive), exposure.light.size, n)),
    )
    for m, own in enumerate(drive):
        random = stream(streams.key("photophysics"), m, 0)
        u, random = drawn(uniform, random)
        state = int(np.searchsorted(np.cumsum(chain.start_vector()), u, side="right"))
        life, random = drawn(exponential, random)
        for f, light in enumerate(exposure.light):
            rates = np.maximum(total_rates[0] + own * light * total_rates[1], 0.0)
            for left, seen in ((exposure.exposure_s, True), (exposure.dead_time_s, False)):
                while left > 0:
                    leaving = rates[state].sum()
                    stay = min(left, life / leaving if leaving else np.inf)
                    stays[m, f, state] += stay * seen
                    life -= leaving * stay
                    if stay == left:
                        break
                    left -= stay
                    u, random = drawn(uniform, random)
                    state_before, state = state, int(np.searchsorted(np.cumsum(rates[state]), u * leaving))
                    if seen and chain.photon_matrix()[state_before, state] > 0:
                        u, random = drawn(uniform, random)
                        photons[m, f] += u < chain.photon_matrix()[state_before, state]
                    life, random = drawn(exponential, random)
    return photons, stays


@pytest.mark.parametrize("dead_s", [0.0, 0.004])
@pytest.mark.parametrize("light", [np.ones(40), np.repeat([1.0, 0.0, 0.5, 2.0], 10), np.linspace(0.5, 1.5, 40)])
def test_passing_by_calm_frames_changes_nothing(dead_s, light):
    """Both engines' loop against the jump process written out, photon by photon, on the same random numbers."""
    chain = Chain(
        ("NA", "S0", "S1", "T1"),
        (
            Transition("NA", "S0", 20.0),
            Transition("S0", "S1", 100.0, driven=True),
            Transition("S1", "S0", 2000.0, photon_probability=0.7),
            Transition("S1", "T1", 400.0),
            Transition("T1", "S0", 9.0),
        ),
        {"NA": 0.8, "S0": 0.2},
    )
    drive, exposure = np.linspace(0.2, 1.5, 12), Exposure(0.01, dead_s, light)
    photons, _ = simulate_photons(chain, drive, exposure, Streams(5), "exact")
    np.testing.assert_array_equal(photons, frame_by_frame(chain, drive, exposure, Streams(5))[0])
    blinking = Chain(
        ("S0", "S1", "T1"),
        (
            Transition("S0", "S1", 1e4, driven=True),
            Transition("S1", "S0", 1e7, photon_probability=1.0),
            Transition("S1", "T1", 8e3),
            Transition("T1", "S0", 6.0),
        ),
        {"T1": 1.0},
    )
    merged = merge_bright_states(blinking)
    _, expected = simulate_photons(blinking, drive, exposure, Streams(6), "fast", with_expected=True)
    lit = frame_by_frame(merged.chain, drive, exposure, Streams(6))[1] @ merged.photon_rates
    assert 0.1 < np.mean(lit > 0) < 0.9
    np.testing.assert_allclose(expected, drive[:, None] * light * lit, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("dead_s", [0.0, 0.003])
def test_a_state_is_left_at_the_rate_that_the_light_of_each_moment_makes(dead_s):
    """Molecules that bleach in a light of their own in every frame, dark in some: how many are left when a frame begins
    is binomial with exp(−∫ rate dt); chi², false alarms 1e-3 together."""
    k01, k10, bleaching = 1e4, 1e7, 1.5e4
    chain = Chain(
        ("S0", "S1", "B"),
        (
            Transition("S0", "S1", k01, driven=True),
            Transition("S1", "S0", k10, photon_probability=1.0),
            Transition("S1", "B", bleaching),
        ),
        {"S0": 1.0},
    )
    n, light = 20_000, np.tile([1.0, 1.0, 0.0, 2.5, 0.4], 8)
    each = np.tile(np.random.default_rng(3).uniform(0.5, 1.5, light.size).astype(np.float32), (n, 1))
    exposure = Exposure(0.002, dead_s, light, each)
    _, expected = simulate_photons(chain, np.ones(n), exposure, Streams(4), "fast", with_expected=True)
    leave = k10 + bleaching
    rate = k01 * leave / (k01 + leave) * bleaching / leave * light * each[0].astype(float)
    still = np.exp(-np.concatenate([[0.0], np.cumsum(rate * (0.002 + dead_s))]))[:-1]
    lit = light > 0
    left = (expected[:, lit] > 0).sum(axis=0)
    gone = np.append(-np.diff(left), left[-1])
    chances = np.append(-np.diff(still[lit]), still[lit][-1])
    assert left[0] == n and chances.min() * n > 20
    assert stats.chisquare(gone, n * chances).pvalue > 5e-4


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_molecules_shared_by_workers_are_the_same(engine):
    chain = protocol_chain(model_of("STORM"))
    each = np.random.default_rng(1).uniform(0.5, 1.5, (50, 30)).astype(np.float32)
    exposure = Exposure(0.01, 0.0, np.ones(30), each)
    alone, shared = (
        simulate_photons(chain, np.full(50, 0.02), exposure, Streams(7), engine, workers=n, with_expected=True)
        for n in (1, 3)
    )
    assert alone[0].any()
    np.testing.assert_array_equal(shared, alone)


def test_photons_are_the_same_whether_what_was_expected_is_kept_or_not():
    """More molecules than are emitted at once, the last of them fewer; each in a light of its own."""
    chain = protocol_chain(model_of("STORM"))
    each = np.random.default_rng(2).uniform(0.5, 1.5, (150, 30)).astype(np.float32)
    exposure = Exposure(0.01, 0.0, np.ones(30), each)
    kept, not_kept = (
        simulate_photons(chain, np.full(150, 0.02), exposure, Streams(8), "fast", with_expected=keep)
        for keep in (True, False)
    )
    assert kept[1].shape == kept[0].shape and not_kept[1].shape == (0, 30)
    np.testing.assert_array_equal(not_kept[0], kept[0])
    assert np.all((kept[1] > 0) | (kept[0] == 0)) and kept[0][-1].any()
