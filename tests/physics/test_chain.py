"""Markov chains against linear algebra: generators, occupancies, dwell times, any set of states."""

import numpy as np
import pytest
from scipy import linalg, stats

from napari_mufasa import MufasaError, preset
from napari_mufasa.chance.streams import Streams
from napari_mufasa.photophysics.chain import Chain, Transition
from napari_mufasa.photophysics.engines import Exposure, simulate_photons
from napari_mufasa.photophysics.protocols import protocol_chain

# The source's whole state space and a further dark state, with rates slow enough to watch single jumps.
FULL = Chain(
    ("NA", "S0", "S1", "T1", "B", "R"),
    (
        Transition("NA", "S0", 8.0),
        Transition("S0", "S1", 400.0, driven=True),
        Transition("S1", "S0", 4.0e5, photon_probability=1.0),
        Transition("S1", "T1", 2.0e4),
        Transition("S1", "R", 8.0e3),
        Transition("S1", "B", 1.0e3),
        Transition("T1", "S0", 60.0),
        Transition("R", "S0", 9.0),
    ),
    {"NA": 1.0},
)


def exposure(n_frames, exposure_s, dead_s=0.0, light=None):
    return Exposure(exposure_s, dead_s, np.ones(n_frames) if light is None else np.asarray(light, float))


@pytest.mark.parametrize("name", ["PALM", "STORM", "FF", "Blinking", "EGFP", "Alexa647-STORM"])
@pytest.mark.parametrize("light", [0.0, 0.3, 1.0, 7.0])
def test_generator_rows_sum_to_zero(name, light):
    generator = protocol_chain(preset(name)).generator(light)
    np.testing.assert_allclose(generator.sum(axis=1) / np.abs(generator).max(), 0, atol=1e-15)
    assert np.all(generator - np.diag(np.diag(generator)) >= 0)


@pytest.mark.parametrize(
    ("name", "states", "start"),
    [
        ("PALM", {"NA", "S0", "S1", "B"}, "NA"),
        ("STORM", {"S0", "S1", "T1", "B"}, "T1"),
        ("FF", {"S0", "S1", "B"}, "S0"),
        ("Blinking", {"S0", "S1", "T1", "B"}, "T1"),
    ],
)
def test_protocols_have_the_states_of_the_specification(name, states, start):
    chain = protocol_chain(preset(name))
    assert set(chain.states) == states
    assert chain.start == {start: 1.0}


def test_null_switches_a_transition_off():
    model = preset("STORM").with_values({"fluorophore.cycles_before_bleaching": None, "fluorophore.isc_ratio": None})
    assert set(protocol_chain(model).states) == {"S0", "S1"}


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_mean_photons_per_frame_follow_the_matrix_exponential(engine):
    """E[photons in a frame] = k10 ∫ P(S1) dt, from the generator's exponential, for six states from NA."""
    n_molecules, n_frames, length = 40_000, 12, 0.02
    photons = simulate_photons(FULL, np.ones(n_molecules), exposure(n_frames, length), Streams(11), engine)[0]
    generator = FULL.generator()
    at = FULL.states.index("S1")
    # The integral of the occupancy of S1 is one more state that only counts.
    counting = np.zeros((7, 7))
    counting[:6, :6], counting[at, 6] = generator, 4.0e5
    start = np.append(FULL.start_vector(), 0.0)
    cumulative = [(start @ linalg.expm(counting * length * f))[6] for f in range(n_frames + 1)]
    sd = photons.std(axis=0) / np.sqrt(n_molecules)
    # 12 frames, |z| > 4.2: overall false alarm 3e-4. The fast engine may differ by O(k01/k10) = 0.1 %.
    difference = np.abs(photons.mean(axis=0) - np.diff(cumulative))
    assert np.all(difference < 4.2 * sd + 1e-3 * np.diff(cumulative))


def test_light_and_dead_time_follow_the_matrix_exponential():
    """The light changes from frame to frame and goes on during the dead time, whose photons are lost."""
    light, exposed, dead, n = [1.0, 0.2, 0.0, 3.0, 1.0], 0.01, 0.015, 40_000
    photons = simulate_photons(FULL, np.ones(n), exposure(5, exposed, dead, light), Streams(12), "fast")[0]
    occupancy, at = FULL.start_vector(), FULL.states.index("S1")
    for f, relative in enumerate(light):
        counting = np.zeros((7, 7))
        counting[:6, :6], counting[at, 6] = FULL.generator(relative), 4.0e5
        mean = (np.append(occupancy, 0.0) @ linalg.expm(counting * exposed))[6]
        occupancy = occupancy @ linalg.expm(FULL.generator(relative) * (exposed + dead))
        # 5 frames, |z| > 4: overall false alarm 3e-4; O(k01/k10) = 0.3 % at threefold light, and 1e-3 of a
        # molecule is excited when the light goes out, whose photon the fast engine puts before the edge.
        tolerance = 4 * photons[:, f].std() / np.sqrt(n) + 4e-3 * mean + 1e-3
        assert abs(photons[:, f].mean() - mean) <= tolerance
    assert not photons[:, 2].any()


@pytest.mark.parametrize("engine", ["fast", "exact"])
def test_long_runs_reach_the_stationary_distribution(engine):
    chain = Chain(
        ("S0", "S1", "T1"),
        (
            Transition("S0", "S1", 2000.0, driven=True),
            Transition("S1", "S0", 1e6, photon_probability=1.0),
            Transition("S1", "T1", 2e4),
            Transition("T1", "S0", 30.0),
        ),
        {"T1": 1.0},
    )
    stationary = linalg.null_space(chain.generator().T)[:, 0]
    stationary /= stationary.sum()
    photons = simulate_photons(chain, np.ones(2000), exposure(20, 0.1), Streams(13), engine)[0]
    totals = photons[:, 10:].sum(axis=1)  # after 1 s ≫ 1/70 s the start is forgotten
    expected = stationary[1] * 1e6 * 1.0
    # |z| > 4: false alarm 6e-5; k01/k10 = 0.2 %.
    assert totals.mean() == pytest.approx(expected, abs=4 * totals.std() / np.sqrt(2000) + 2e-3 * expected)


def test_activation_and_bleaching_times_are_exponential():
    """Dwell times by event: waiting for the first light (NA) and until the last (bleaching), KS at 1e-4 each."""
    length = 1e-3
    chain = Chain(
        ("NA", "S0", "S1", "B"),
        (
            Transition("NA", "S0", 10.0),
            Transition("S0", "S1", 1e5, driven=True),
            Transition("S1", "S0", 1e8, photon_probability=1.0),
            Transition("S1", "B", 2e4),  # 1e5 · 2e4/1e8 = 20 bleachings per s
        ),
        {"NA": 1.0},
    )
    photons = simulate_photons(chain, np.ones(4000), exposure(2000, length), Streams(14), "fast")[0]
    on = photons > 0
    seen = on.any(axis=1)  # one in 5000 bleaches before its first photon: of 4000, nine or more with chance 2e-7
    assert (~seen).sum() < 9
    on = on[seen]
    first = on.argmax(axis=1)
    last = on.shape[1] - on[:, ::-1].argmax(axis=1)
    # Times known to a frame: jitter inside the frame makes them continuous again.
    jitter = np.random.default_rng(1).random((2, len(on))) - 0.5
    assert stats.kstest((first + 0.5 + jitter[0]) * length, "expon", args=(0, 1 / 10)).pvalue > 1e-4
    lifetime = (last - first + jitter[1] - jitter[0]) * length
    # Lifetimes below a frame are blurred by the frame: compare those beyond three frames (no memory).
    beyond = lifetime[lifetime > 3 * length] - 3 * length
    assert stats.kstest(beyond, "expon", args=(0, 1 / 20)).pvalue > 1e-4


def test_dark_dwell_times_of_a_further_dark_state_are_exponential():
    chain = Chain(
        ("S0", "S1", "X"),
        (
            Transition("S0", "S1", 1e5, driven=True),
            Transition("S1", "S0", 1e8, photon_probability=1.0),
            Transition("S1", "X", 2e4),
            Transition("X", "S0", 25.0),
        ),
        {"X": 1.0},
    )
    length = 1e-3
    photons = simulate_photons(chain, np.ones(3000), exposure(1000, length), Streams(15), "fast")[0]
    first = (photons > 0).argmax(axis=1)
    jitter = np.random.default_rng(2).random(3000)
    assert stats.kstest((first + jitter) * length, "expon", args=(0, 1 / 25)).pvalue > 1e-4


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda: Chain(("A", "B"), (Transition("A", "C", 1.0),), {"A": 1.0}), "A→C"),
        (lambda: Chain(("A", "B"), (Transition("A", "A", 1.0),), {"A": 1.0}), "A→A"),
        (lambda: Chain(("A", "B"), (Transition("A", "B", -1.0),), {"A": 1.0}), "-1.0"),
        (lambda: Chain(("A", "B"), (Transition("A", "B", np.nan),), {"A": 1.0}), "nan"),
        (lambda: Chain(("A", "B"), (), {"A": 0.4}), "probabilities"),
        (lambda: Chain(("A", "B"), (), {"Z": 1.0}), "probabilities"),
        (lambda: Chain(("A", "A"), (), {"A": 1.0}), "twice"),
    ],
)
def test_a_wrong_chain_is_refused(build, says):
    with pytest.raises(MufasaError, match=says):
        build()


def test_rates_between_the_same_states_add_up_and_names_stay_free():
    chain = FULL.with_transitions(Transition("T1", "S0", 40.0))
    assert chain.generator()[3, 1] == pytest.approx(100.0)
    assert FULL.free_name("R") == "R_2"
    assert FULL.free_name("Q") == "Q"
