"""Photophysics inferred from traces: what a model's rates must be, with intervals and what cannot be told apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.calibrate.known import Known
from napari_mufasa.calibrate.value import NORMAL, Value
from napari_mufasa.errors import MufasaError
from napari_mufasa.infer.likelihood import Fitted, Problem, fitted, own_factors, unpacked, with_errors
from napari_mufasa.model.model import Model
from napari_mufasa.photophysics import rates

if TYPE_CHECKING:
    from napari_mufasa.files.traces import TraceFile
    from napari_mufasa.traces.dynamics import Dynamics
    from napari_mufasa.traces.extract import TraceSet
    from napari_mufasa.traces.options import Options

LEAST_MOLECULES = 5
EVIDENCE = 6.9  # log likelihood that a dark state must add: chance 1 in 1000 with its two rates where there is none
FAST = 1.0  # switches per frame from which on they show as a dimmer, noisier level
SURE_SD = 1.0  # above the threshold of detection, from where on most molecules are found
DITHERED = 0.5  # counts of noise from which on rounding to whole counts is right on average, to 0.002 of a count
UNCERTAIN = 1.5  # sd of a logarithm from which on a number is not known


@dataclass(frozen=True)
class Photophysics(Known):
    """What traces say of the molecules.

    Attributes
    ----------
    model : the believed model with the numbers inferred; others as believed
    values : by name, each with its 95 % interval: `level_e` (photoelectrons of a frame that is bright throughout),
        `photons_per_frame` (on the detector), `k01_per_s`, `bleaching_rate_per_s` and `off_rate_per_s` (while bright),
        and, named as in a model, `cycles_before_bleaching`, `isc_ratio`, `triplet_decay_rate_per_s`,
        `activation_rate_per_s`; `brightness_spread` (relative sd between molecules)
    unknown : by name, why a value could not be known, with a limit where there is one
    notes : what cannot be told apart, and what else a user should know
    n_molecules : traces used
    """

    n_molecules: int

    def report(self) -> dict[str, Any]:
        """Plain data."""
        return super().report() | {"n_molecules": self.n_molecules}


def infer_photophysics(
    traces: NDArray[Any] | TraceFile | TraceSet,
    model: Model,
    *,
    unit: str | None = None,
    pixel_share: float | None = None,
    background_subtracted: bool | None = None,
    all_molecules: bool = False,
    progress: Callable[[int, int], None] | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Photophysics:
    """Brightness and rates of most likelihood: a chain of bright, dark, bleached (and, in PALM, not yet activated)
    molecules, whose frames may be bright in part (docs/inference.md).

    Parameters
    ----------
    traces : (molecule, frame) light in `unit`, whole movies in which the light stays on; or what `read_trace_file` or
        `extract_traces` gave (of which the kept molecules are used), which say themselves what they hold
    model : timing, dye, light, collection and camera believed; only photons per frame and rates show in traces
    unit : "photoelectrons" (None, of an array), "photons" or "adu"
    pixel_share : share of a molecule's light that a trace holds; None: all, or as extracted or read
    background_subtracted : whether the background was taken off (in ADU: the baseline, too); None: yes, but for ADU,
        which are taken as recorded. What is in them is read off where molecules go dark, and taken off
    all_molecules : whether all molecules are among the traces, also those that never shone (their places were known);
        else those that shone in fewer frames than it takes to be found (3, or as extracted) are left out, and the
        likelihood is that of molecules that shine as long
    progress, cancel : see `simulate`

    Raises
    ------
    MufasaError : fewer than 5 traces, too few frames, traces without light or without noise, or with a background that
        no dark molecule tells.
    """
    from napari_mufasa.compare.comparison import described, to_photoelectrons
    from napari_mufasa.files.traces import TraceFile
    from napari_mufasa.traces.dynamics import LIT, dynamics
    from napari_mufasa.traces.extract import TraceSet, held_share
    from napari_mufasa.traces.select import Choice

    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    notes: list[str] = []
    least_frames: float = Choice.min_lit_frames
    table, unit, profile, without = described(traces, unit, None, background_subtracted)
    if isinstance(traces, TraceFile):
        pixel_share = held_share(cast(Any, profile), model.sigma_px) if pixel_share is None else pixel_share
    if isinstance(traces, TraceSet):
        if not traces.options.subtract_background:
            raise MufasaError("rates are inferred from light alone: extract the traces with their background taken off")
        pixel_share = traces.pixel_share if pixel_share is None else pixel_share
        least_frames = _least_frames(traces)
        notes += _chosen(traces.options)
        table = traces.all_traces[traces.kept]
    electrons = to_photoelectrons(table, model, unit, background_subtracted=without)
    if not without:
        electrons, note = _above_background(electrons)
        notes.append(note)
    electrons = electrons / (pixel_share or 1.0)
    if len(electrons) < LEAST_MOLECULES:
        raise MufasaError(f"{len(electrons)} traces are too few to infer rates from: give {LEAST_MOLECULES} or more")
    if electrons.shape[1] < 10:
        raise MufasaError(f"traces of {electrons.shape[1]} frames are too short to infer rates from: give 10 or more")
    tell = progress or (lambda done, total: None)
    seen = dynamics(electrons.astype(np.float32))
    if not seen.lit.any():
        raise MufasaError("no trace is bright anywhere: check the unit, and that the background was taken off once")
    timing, least_s = model.acquisition, None
    if not all_molecules:
        shone = (seen.snr >= Choice.min_snr) & (seen.lit.sum(axis=1) >= least_frames)
        if shone.sum() < LEAST_MOLECULES:
            raise MufasaError(
                f"{shone.sum()} molecules shine in {least_frames:.0f} frames or more, as it takes to be found: "
                f"{LEAST_MOLECULES} are needed; give places (positions_px), or record brighter or longer"
            )
        if not shone.all():
            notes.append(
                f"{(~shone).sum()} molecules that shine in fewer than {least_frames:.0f} frames are left out, and the "
                "rates allow for it: others as short-lived were not found"
            )
        electrons, seen = electrons[shone], seen.of(shone)
        least_s = (least_frames - 1) * timing.interval_s + LIT * timing.frame_length_s
    problem = Problem(
        np.ascontiguousarray(electrons), timing.frame_length_s, timing.interval_s - timing.frame_length_s, least_s
    )
    waits = ("activation",) if model.protocol == "PALM" else ()
    tell(0, 3)
    found = fitted(problem, seen, ("bleaching", "off", "back", *waits), cancel)
    tell(1, 3)
    blinks, plain = seen.n_blinks.sum() >= len(electrons), found  # obviously; else both chains are compared
    if not blinks:
        plain = fitted(problem, seen, ("bleaching", *waits), cancel)
        blinks = found.score - plain.score > EVIDENCE
    tell(2, 3)
    best = found if blinks else plain
    if (factors := own_factors(problem, best)).std() > 0:
        rates_fitted = tuple(name for name in ("bleaching", "off", "back", "activation") if best.has(name))
        best = fitted(problem, seen, rates_fitted, cancel, factors)
    best = with_errors(problem, seen, best)
    tell(3, 3)
    values, unknown = _values(best, model, seen, problem, notes)
    if not best.has("offset"):
        notes.append(
            "hardly a frame is dark: what is left of the background, if any, counts as light of the molecules in level "
            "and k01"
        )
    if not blinks:
        unknown["isc_ratio"] = "the traces show no dark state between bright frames" + _limit(best, problem)
    notes += _coarse_counts(model) + _cannot_be_told(model, best)
    return Photophysics(_model(model, values, blinks, notes), values, unknown, tuple(notes), len(electrons))


def _above_background(electrons: NDArray[np.float64]) -> tuple[NDArray[np.float64], str]:
    """Traces (molecule, frame) without the background that they fall to when their molecules are dark, and a note."""
    from napari_mufasa.traces.darkness import dark_level

    if (dark := dark_level(electrons)) is None:
        raise MufasaError(
            "the traces hold their background, and too few molecules go dark, or to no common level, to tell how much "
            "of them it is: give traces whose background was taken off (background_subtracted=True), or longer ones"
        )
    return (
        electrons - dark,
        f"{dark:.4g} photoelectrons per frame, to which the traces fall, were taken off as background",
    )


def _least_frames(found: TraceSet) -> float:
    """In how many frames a molecule must be lit to be surely among the traces: what was asked for, or what the usual
    one needs to be found by its light."""
    from napari_mufasa.spots.find import NOISE_SD
    from napari_mufasa.spots.times import frames_needed

    options, table = found.options, found.molecules[found.kept]
    asked = float(max(options.min_lit_frames, options.window or 0, 1))
    if options.follow_molecules:
        return max(asked, float(options.min_found))
    needed = frames_needed(
        table["significance"].to_numpy(), table["lit_frames"].to_numpy(), found.all_traces.shape[1],
        (options.threshold_value or NOISE_SD) + SURE_SD, options.time_block,
    )  # fmt: skip
    if options.threshold != "sigma" or not np.isfinite(needed).any():  # places were given
        return asked
    return max(asked, float(np.nanmedian(needed)))


def _chosen(options: Options) -> list[str]:
    """What a choice of molecules by what their traces do leaves out, in words."""
    by = [f"window = {options.window}"] if options.window is not None else []  # of it only the time in light is known
    by += [f"best = {options.best}"] if options.best is not None else []
    by += [f"min_steps = {options.min_steps}"] if options.min_steps else []
    by += [f"max_lit_share = {options.max_lit_share:g}"] if options.max_lit_share < 1 else []
    if not by:
        return []
    return [
        f"the molecules were chosen by {', '.join(by)}, and rates and level are those of the chosen: extract without"
    ]


def _values(
    best: Fitted, model: Model, seen: Dynamics, problem: Problem, notes: list[str]
) -> tuple[dict[str, Value], dict[str, str]]:
    dye, optics = model.fluorophore, model.optics
    k10 = rates.relaxation_rate(dye.lifetime_s)
    share = optics.collection_efficiency * optics.brightness_correction * model.camera.quantum_efficiency
    per_excited = dye.quantum_yield * k10 * model.acquisition.frame_length_s * share  # e⁻ if always in S1
    common = float(np.mean(best.factors))
    log_level, sd_level = best.log("level")
    log_level += np.log(common)
    excited = min(float(np.exp(log_level)) / per_excited, 0.99)
    unknown: dict[str, str] = {}
    values = {
        "level_e": _value(log_level, sd_level),
        "photons_per_frame": _value(log_level - np.log(model.camera.quantum_efficiency), sd_level),
    }
    bright_s = _bright_s(best, seen, problem)
    leaves = 0.0
    for name, told in (("bleaching", "bleaching_rate_per_s"), ("off", "off_rate_per_s")):
        if not best.has(name):
            continue
        log, sd = best.log(name)
        events = float(np.exp(log)) * bright_s
        if events < rates.FEW_EVENTS:
            most = rates.most_per_s(events, bright_s)
            unknown[told] = f"about {events:.1f} events were seen in {bright_s:.3g} s of light: below {most:.3g} 1/s"
            continue
        if sd > UNCERTAIN:
            unknown[told] = "the traces do not tell: too faint, or too few frames before molecules go dark"
            continue
        values[told] = _value(log, sd)
        leaves += float(np.exp(log))
        if name == "bleaching":  # N_c = cycles per second while bright / rate
            log_n, sd_n = best.combined(level=1.0, bleaching=-1.0)
            shift = np.log(common / per_excited * k10)
            values["cycles_before_bleaching"] = _value(log_n + shift, sd_n)
        else:
            log_a, sd_a = best.combined(off=1.0, level=-1.0)
            values["isc_ratio"] = _value(log_a - np.log(common / per_excited * k10), sd_a)
    # excited = k01 / (k01 + k10 + k1T + k1B), and what leaves is excited · (k1T + k1B)
    values["k01_per_s"] = _value(np.log((k10 + leaves / excited) * excited / (1 - excited)), sd_level / (1 - excited))
    for name, told in (("back", "triplet_decay_rate_per_s"), ("activation", "activation_rate_per_s")):
        if best.has(name):
            log, sd = best.log(name)
            if sd > UNCERTAIN:
                unknown[told] = "too few returns to light to tell"
            else:
                values[told] = _value(log, sd)
    for name in ("off", "back"):
        if best.has(name) and np.exp(best.log(name)[0]) * problem.frame_s > FAST:
            notes.append("molecules switch more than once in a frame: rates that fast blur into level and noise")
            break
    spread = float(np.std(np.log(best.factors)))
    if spread > 0:
        values["brightness_spread"] = Value(spread, spread / np.sqrt(2 * len(best.factors)))
    return values, unknown


def _value(log: float, sd: float) -> Value:
    """A positive number by its logarithm, with an interval even in it."""
    size = float(np.exp(log))
    return Value(size, size * sd, size * float(np.exp(-NORMAL * sd)), size * float(np.exp(NORMAL * sd)))


def _bright_s(best: Fitted, seen: Dynamics, problem: Problem) -> float:
    """Time that the molecules were bright, all together: their light over the level of a bright frame."""
    _, level, offset, _ = unpacked(best.names, best.point)
    frames = float(np.sum((problem.traces - offset) / (level * best.factors[:, None])))
    most = problem.traces.size
    return float(np.clip(frames, 0.5 * seen.lit.sum(), most)) * (problem.frame_s + problem.dead_s)


def _limit(best: Fitted, problem: Problem) -> str:
    _, level, offset, _ = unpacked(best.names, best.point)
    bright_s = float(np.sum(problem.traces - offset)) / level * (problem.frame_s + problem.dead_s)
    return f" (in {bright_s:.3g} s of light)" if bright_s > 0 else ""


def _coarse_counts(model: Model) -> list[str]:
    """What a converter does to light whose noise does not reach from one of its counts to the next, in words."""
    from napari_mufasa.camera import cmos_response, multiplication_noise
    from napari_mufasa.compare.fit import background_level_e

    camera = model.in_shape(maps=None).camera
    slope = float(camera.em_gain or 1.0) if camera.type == "EMCCD" else 1.0
    if camera.type == "CMOS":
        slope = float(cmos_response(np.ones(1, np.float32), camera)[0])
    noise_e = np.hypot(slope * np.sqrt(multiplication_noise(camera) * background_level_e(model)), camera.read_noise_e)
    if noise_e >= DITHERED * camera.electrons_per_adu:
        return []
    return [
        f"a count of the camera believed is {camera.electrons_per_adu:.4g} electrons, the noise of a pixel beside the "
        f"molecules {noise_e:.2g}: such rounding is not right on average, and level and k01 are off by more than their "
        "intervals say; more background or a finer converter (gain) helps"
    ]


def _cannot_be_told(model: Model, best: Fitted) -> list[str]:
    said = [
        "ε, power, wavelength, collection, quantum yield and quantum efficiency show only as their product, photons "
        "per frame: k01 holds for those believed, and with it N_c and α_isc, of which only rates while bright are seen",
        "a molecule that is dark at the end may come back: dark times longer than the movie count as bleaching",
    ]
    if best.has("off"):
        said.append(
            "one dark state is believed: dark times much shorter than a frame are seen as less light, and a second, "
            "slower one as bleaching or as a longer mean"
        )
    if best.has("activation"):
        said.append("a molecule not yet activated looks like one that starts in a long dark state")
    return said


def _model(model: Model, values: dict[str, Value], blinks: bool, notes: list[str]) -> Model:
    """The believed model with what was inferred."""
    dye, light = model.fluorophore, model.excitation
    per_power = rates.excitation_rate(dye.extinction_coefficient_per_M_cm, 1.0, light.wavelength_nm)
    changes: dict[str, Any] = {"excitation.power_density_w_per_cm2": values["k01_per_s"].value / per_power}
    if "cycles_before_bleaching" in values:
        changes["fluorophore.cycles_before_bleaching"] = values["cycles_before_bleaching"].value
    if "activation_rate_per_s" in values:
        changes["excitation.activation_rate_per_s"] = values["activation_rate_per_s"].value
    if blinks and "isc_ratio" in values and "triplet_decay_rate_per_s" in values:
        if model.protocol == "PALM":
            notes.append("the protocol PALM has no dark state: the effect long_dark_state gives the model one")
        else:
            changes["fluorophore.isc_ratio"] = min(values["isc_ratio"].value, 1.0)
            changes["fluorophore.triplet_decay_rate_per_s"] = values["triplet_decay_rate_per_s"].value
            if model.protocol == "FF":
                changes["protocol"] = "Blinking"
    return model.with_values(changes)
