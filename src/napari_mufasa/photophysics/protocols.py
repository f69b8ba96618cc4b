"""Which states and rates each protocol has (docs/photophysics.md): its chain."""

from __future__ import annotations

from napari_mufasa.model.setup import Setup
from napari_mufasa.photophysics import rates
from napari_mufasa.photophysics.chain import Chain, Transition


def protocol_chain(setup: Setup) -> Chain:
    """The chain of the set-up's protocol; transitions that are ``null`` in the set-up are absent.

    FF {S0,S1,B} from S0 · Blinking and STORM {S0,S1,T1,B} from T1 · PALM {NA,S0,S1,B} from NA.
    """
    dye, light = setup.fluorophore, setup.excitation
    k01 = rates.excitation_rate(dye.extinction_coefficient_per_M_cm, light.power_density_w_per_cm2, light.wavelength_nm)
    states = ["S0", "S1"]
    transitions = [
        Transition("S0", "S1", k01, driven=True),
        Transition("S1", "S0", rates.relaxation_rate(dye.lifetime_s), photon_probability=dye.quantum_yield),
    ]
    start = "S0"
    if setup.protocol in ("Blinking", "STORM") and dye.isc_ratio:
        states.append("T1")
        transitions.append(Transition("S1", "T1", rates.intersystem_crossing_rate(dye.isc_ratio, dye.lifetime_s)))
        if dye.triplet_decay_rate_per_s:
            transitions.append(Transition("T1", "S0", dye.triplet_decay_rate_per_s))
            start = "T1"
    if dye.cycles_before_bleaching is not None:
        states.append("B")
        transitions.append(Transition("S1", "B", rates.bleaching_rate(dye.cycles_before_bleaching, dye.lifetime_s)))
    if setup.protocol == "PALM" and light.activation_rate_per_s is not None:
        states.insert(0, "NA")
        transitions.append(Transition("NA", "S0", light.activation_rate_per_s))
        start = "NA"
    return Chain(tuple(states), tuple(transitions), {start: 1.0})
