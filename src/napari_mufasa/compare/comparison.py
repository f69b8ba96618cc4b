"""One comparison: measured traces against a model and two baselines, with floor and intervals (docs/comparison.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.chance.streams import Streams
from napari_mufasa.compare.distributions import Distribution, Sample, distributions
from napari_mufasa.compare.fit import (
    Fit,
    background_held,
    background_level_e,
    fit_gain,
    fit_model,
    fit_raw_traces,
)
from napari_mufasa.compare.simulated import FarApart, SofiTimes, acquisitions, background_weight, extract_simulated
from napari_mufasa.compare.wasserstein import Floor, bootstrap_interval, floor, wasserstein
from napari_mufasa.errors import Cancelled, MufasaError
from napari_mufasa.files.traces import UNITS, TraceFile
from napari_mufasa.model.model import Model
from napari_mufasa.simulate import layout
from napari_mufasa.simulate.movie import SimulatedAcquisition
from napari_mufasa.spots.aperture import Profile
from napari_mufasa.traces import Options, TraceSet, extract_traces
from napari_mufasa.traces.dynamics import dynamics
from napari_mufasa.traces.options import chosen_options
from napari_mufasa.traces.select import windows

Progress = Callable[[int, int], None]
Cancel = Callable[[], bool]
FIT_FAILED = (
    "fitting brightness, background and bleaching does not bring this model nearer: their means are those of the "
    "measurement, the law is not, or the molecules are too few"
)
FEW_TRACES = 5  # W1 of fewer is told to rest on few
ENOUGH_MOLECULES, MOST_MOVIES = 600, 4  # simulated behind a W1 and a fit; movies made to get there


@dataclass(frozen=True)
class Comparison:
    """W1 of the model ("mufasa"), the Poisson and SOFI baselines and, where asked for, the fitted model.

    Attributes
    ----------
    w1 : {"mufasa", "poisson", "sofi", "fitted"?, "floor", "unit"}, over frames
    w1_traces : the same over whole traces; w1_interval : name → 95 % interval over frames
    samples : name → traces with their dynamics, "measured" first
    distributions : name → `Distribution`, measured and simulated on one axis
    model, fit : the model compared, and the nuisance fit (None when not asked for)
    measured : the measured `TraceSet` when the input was a movie
    """

    w1: dict[str, Any]
    w1_traces: dict[str, Any]
    w1_interval: dict[str, tuple[float, float]]
    floor: Floor
    samples: dict[str, Sample]
    distributions: dict[str, Distribution]
    model: Model
    fit: Fit | None = None
    measured: TraceSet | None = None
    notes: tuple[str, ...] = ()

    @property
    def nearer(self) -> str:
        """Which is nearer to the measurement, the model ("mufasa") or the fitted one ("fitted"); that where both are
        within the range of the floor."""
        model, fitted = self.w1["mufasa"], self.w1.get("fitted")
        if fitted is None or (model is not None and fitted > max(model, self.floor.high)):
            return "mufasa"
        return "fitted"

    def report(self) -> dict[str, Any]:
        """Plain data for report.json (docs/files.md)."""
        return {
            "w1": self.w1,
            "w1_traces": self.w1_traces,
            "w1_interval_95": {name: list(pair) for name, pair in self.w1_interval.items()},
            "floor_range_95": [self.floor.low, self.floor.high],
            "molecules": {name: len(s.traces) for name, s in self.samples.items()},
            "frames": {name: int(s.traces.shape[1]) for name, s in self.samples.items()},
            "fitted": None if self.fit is None else self.fit.values,
            "fitted_model": None if self.fit is None else self.fit.model.to_dict(),
            "distributions": {name: d.as_dict() for name, d in self.distributions.items()},
            "model": self.model.to_dict(),
            "notes": list(self.notes),
        }


def compare_movie(
    movie: Any,
    model: Model,
    dark: Any = None,
    *,
    seed: int = 0,
    fit: bool = True,
    sofi_times: SofiTimes = "model",
    options: Options | None = None,
    n_bootstrap: int = 100,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
    **changes: Any,
) -> Comparison:
    """Compare a measured movie with a model, the baselines and (with `fit`) the fitted model.

    Traces are extracted from the movie; every model is simulated with molecules at the candidates' places, or, where
    one of its effects leaves many molecules too dim to be candidates, with as many as it has in places of their own;
    recorded by the model's camera, and extracted by the same detection and selection.

    Parameters
    ----------
    movie : (frame, y, x) ADU; dark : dark frames, which replace the baseline
    options, **changes : as for `extract_traces`; the PSF width defaults to the model's
    fit : also fit the model to the traces by moments (see `fit_model`) and compare the result
    sofi_times : time scales of the SOFI baseline: those of the "model" or those the "tool" starts with
    progress : called with (steps done, steps); cancel : True stops (raises `Cancelled`)

    Raises
    ------
    MufasaError : a movie, dark frames or option that cannot be used; no molecule left to compare.
    """
    _check(model, seed, sofi_times, n_bootstrap)
    movie = checks.stack(movie)
    options = chosen_options(options, changes)
    if options.follow_molecules:
        raise MufasaError("follow_molecules: a comparison reads the model's molecules in their places; leave it out")
    if options.psf_sigma_px is None:
        options = replace(options, psf_sigma_px=model.sigma_px)
    steps = _Steps(progress, 6 if fit else 4, cancel)
    measured = extract_traces(movie, model.camera, dark, options=options, cancel=cancel)
    steps.done()
    if not measured.kept.any():
        raise MufasaError(
            f"no molecule left to compare: {len(measured.molecules)} candidates, all rejected "
            f"({_most_frequent(measured)}); lower the threshold or relax the selection"
        )
    model = model.in_shape(n_frames=movie.shape[0], shape_px=movie.shape[1:])
    places = _places(model, measured, seed)
    # Few molecules of unequal brightness are few samples: several movies make the model's W1, and a fit, steadier.
    repeats = int(np.clip(ENOUGH_MOLECULES // int(measured.kept.sum()), 1, MOST_MOVIES))

    def simulate(candidate: Model, first_seed: int = seed, but: int = 0) -> list[TraceSet]:
        seeds = [first_seed + 1000 * i for i in range(but, repeats)]
        movies = (SimulatedAcquisition(candidate, _places(model, measured, each), each) for each in seeds)
        return [extract_simulated(a, options, cancel=cancel) for a in movies]

    weight = 0.0 if options.subtract_background else background_weight(measured.sigma_px, options)

    def above(found: TraceSet, level_e: float) -> TraceSet:
        return replace(found, traces=found.traces - weight * level_e)

    pedestal_e = weight * background_level_e(model)
    samples = {"measured": _sample(measured.traces, weight * measured.background_e)}
    for name, acquisition in acquisitions(model, places, seed, sofi_times).items():
        found = [extract_simulated(acquisition, options, cancel=cancel)]
        found += simulate(model, but=1) if name == "mufasa" else []
        samples[name] = _sample(np.concatenate([each.traces for each in found]), pedestal_e)
        steps.done()
    fitted = None
    if fit:
        fitted = fit_model(
            above(measured, measured.background_e), model,
            lambda candidate: [above(found, background_level_e(candidate)) for found in simulate(candidate)],
        )  # fmt: skip
        steps.done()
        # Another seed than the fit used: the fit must not profit from its own chance.
        again = np.concatenate([found.traces for found in simulate(fitted.model, seed + 10)])
        samples["fitted"] = _sample(again, weight * background_level_e(fitted.model))
        steps.done()
    notes = measured.notes + tuple(
        f"{name}: no molecule was detected in the simulated movie" for name, s in samples.items() if not len(s.traces)
    )
    return _compare(samples, model, measured.units, seed, n_bootstrap, fitted, measured, notes)


def compare_traces(
    traces: NDArray[Any] | TraceFile | TraceSet,
    model: Model,
    *,
    unit: str | None = None,
    profile: str | None = None,
    background_subtracted: bool | None = None,
    pixel_share: float | None = None,
    window: int | None = None,
    best: int | None = None,
    seed: int = 0,
    fit: bool = True,
    sofi_times: SofiTimes = "model",
    n_simulated: int | None = None,
    n_bootstrap: int = 100,
    progress: Progress | None = None,
    cancel: Cancel | None = None,
) -> Comparison:
    """Compare traces without a movie with a model, the baselines and (with `fit`) the fitted model.

    The model supplies camera, photophysics and the share of light that `profile` collects; molecules are
    simulated far apart, with any place within their pixel.

    Parameters
    ----------
    traces : (molecule, frame), or what `read_trace_file` or `extract_traces` gave, which say themselves what they hold
    unit : "photoelectrons" (None, of an array), "photons" or "adu"
    profile : what the traces hold: "brightest_pixel", "sum" or "psf" (None, of an array)
    pixel_share : share of a molecule's light in its brightest pixel, if it is not the PSF's
    background_subtracted : whether the local background was taken off the traces (in ADU: the baseline, too); None:
        yes, but for ADU, which are taken as recorded. Where it is in them, light is told above what traces fall to
        when molecules go dark, or, where too few do, above the model's background
    window, best : cut measured and simulated traces alike to the `window` frames before bleaching in which
        they are active; keep the `best` of the measured ones by SNR, and of simulated ones the same share
    n_simulated : simulated molecules (None: as many as measured, at least 200)
    sofi_times, progress, cancel : as for `compare_movie`

    Raises
    ------
    MufasaError : traces or options that cannot be used.
    """
    _check(model, seed, sofi_times, n_bootstrap)
    for name, value, least in (("window", window, 1), ("best", best, 1), ("n_simulated", n_simulated, 2)):
        if value is not None:
            checks.whole(value, name, least)
    table, unit, profile, background_subtracted = described(traces, unit, profile, background_subtracted)
    electrons = to_photoelectrons(table, model, unit, background_subtracted=background_subtracted)
    if window is not None and window > electrons.shape[1]:
        raise MufasaError(f"window = {window} frames; the traces have {electrons.shape[1]}: give 1 … that")
    n_frames = electrons.shape[1]
    model = model.in_shape(n_frames=n_frames)
    options = Options(psf_sigma_px=model.sigma_px, profile=profile, subtract_background=background_subtracted)  # type: ignore[arg-type]
    n = n_simulated or max(200, len(electrons))
    steps = _Steps(progress, 5 if fit else 4, cancel)
    field = FarApart(model.sigma_px, n, options, seed, pixel_share)
    weight = 1.0 if field.one_pixel else background_weight(model.sigma_px, options)

    def background_of(traces_e: NDArray[np.floating], believed_e: float, own: bool = True) -> tuple[float, str]:
        return (0.0, "") if background_subtracted else background_held(traces_e, believed_e, own)

    believed_e = weight * background_level_e(model)
    pedestal_e, note = background_of(electrons, believed_e)
    seen, own = _cut(electrons, pedestal_e, window), not note
    if len(seen.traces) == 0:
        raise MufasaError(f"no trace is active in the {window} frames before bleaching: choose a smaller window")
    share = min(1.0, (best or np.inf) / len(seen.traces))
    samples = {"measured": _best(seen, pedestal_e, share)}
    notes = [note] if note else []

    def like_measured(traces_e: NDArray[np.floating], believed_e: float) -> tuple[Sample, str]:
        """Cut and chosen as the measured ones, above a background told as theirs; and a note where it cannot be."""
        pedestal_e, note = background_of(traces_e, believed_e, own)
        return _best(_cut(traces_e, pedestal_e, window), pedestal_e, share), note if own else ""

    def simulate(candidate: Model) -> NDArray[np.float32]:
        return field.traces(field.acquisition(candidate, seed), cancel)

    steps.done()
    for name, acquisition in field.acquisitions(model, seed, sofi_times).items():
        samples[name], note = like_measured(field.traces(acquisition, cancel), believed_e)
        notes += [f"{name}: {note}"] if note and name == "mufasa" else []  # the others may never be dark by their law
        steps.done()
    fitted = None
    if fit:
        gain = 1.0
        start = model
        if unit == "adu" and not background_subtracted:  # else what scatters is not what is left
            start, gain = fit_gain(np.asarray(table), model)
        if background_subtracted:
            fitted = fit_model(electrons / gain, start, simulate)
        else:
            fitted = fit_raw_traces(electrons / gain, start, simulate, weight)
        if gain != 1.0:
            fitted.values["camera.em_gain"] = float(fitted.model.camera.em_gain or 1.0)
        # Another seed than the fit used: the fit must not profit from its own chance. A fitted gain changes
        # what a photoelectron is worth in ADU; all samples stay in the unit of the model as given.
        again = field.acquisition(fitted.model, seed + 10)
        fitted_e = gain * weight * background_level_e(fitted.model)
        samples["fitted"], note = like_measured(gain * field.traces(again, cancel), fitted_e)
        notes += [f"fitted: {note}"] if note else []
        steps.done()
    notes += [f"{name}: no active trace in the window" for name, s in samples.items() if len(s.traces) == 0]
    return _compare(samples, model, "photoelectrons", seed, n_bootstrap, fitted, None, tuple(notes))


class Described(NamedTuple):
    """A table of traces (molecule, frame) and what it holds."""

    traces: Any
    unit: str
    profile: str
    background_subtracted: bool


def described(
    traces: Any, unit: str | None = None, profile: str | None = None, background_subtracted: bool | None = None
) -> Described:
    """Traces and what they hold: as given, else as the file or extraction that they come from says, else photoelectrons
    of whole spots. Raises `MufasaError` for another unit than those say."""
    said: tuple[str | None, str | None, bool | None] = (None, None, None)
    if isinstance(traces, TraceFile):
        said, traces = (traces.unit, traces.profile, traces.background_subtracted), traces.traces
    elif isinstance(traces, TraceSet):
        options = traces.options
        said, traces = (traces.units, options.profile, options.subtract_background), traces.traces
    if said[0] is not None and unit not in (None, said[0]):
        raise MufasaError(f"the traces are in {said[0]}, not in {unit}: drop unit, they say it themselves")
    unit = checks.choice(unit or said[0] or "photoelectrons", "unit", UNITS)
    profile = checks.choice(profile or said[1] or "psf", "profile", get_args(Profile))
    stated = said[2] if background_subtracted is None else background_subtracted
    return Described(traces, unit, profile, is_without_background(unit, stated))


def is_without_background(unit: str, stated: bool | None) -> bool:
    """Whether the background was taken off traces: as stated, or (None) unless they are in ADU, as recorded."""
    return unit != "adu" if stated is None else stated


def to_photoelectrons(
    traces: NDArray[Any], model: Model, unit: str, *, background_subtracted: bool = False
) -> NDArray[np.float64]:
    """Traces (molecule, frame) in photoelectrons from photons or ADU: as recorded, with the baseline, or, with
    `background_subtracted`, without it."""
    from napari_mufasa import camera as detector
    from napari_mufasa.camera.readout import without_readout

    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    checks.choice(unit, "unit", UNITS)
    array = checks.table(traces, "traces")
    if unit == "photoelectrons":
        return array.astype(np.float64)
    if unit == "photons":
        return array * model.camera.quantum_efficiency
    plain = without_readout(model.in_shape(maps=None).camera)
    if background_subtracted:  # and the baseline with it: half a count undoes the floor no more
        plain = plain.model_copy(update={"baseline_adu": 0.5, "read_noise_mean_e": 0.0})
    return detector.photoelectrons(array[:, None, :], plain)[:, 0].astype(np.float64)


def _check(model: Any, seed: Any, sofi_times: Any, n_bootstrap: Any) -> None:
    checks.need(model, Model, "model", "give preset(NAME) or Model.from_json(PATH)")
    checks.seed(seed)
    checks.choice(sofi_times, "sofi_times", get_args(SofiTimes))
    checks.whole(n_bootstrap, "n_bootstrap", 1)


_NOT_MOLECULES = ("narrower than the PSF", "never on")


def _places(model: Model, measured: TraceSet, seed: int) -> NDArray[np.float64]:
    """Where molecules are simulated (molecule, 2): where candidates were found. They are a selection by brightness: a
    model that says how many are too dim to be found has all its molecules, in places of its own."""
    if model.hides_molecules:
        return layout.place(model, Streams(seed).of("positions"))
    candidates = ~measured.molecules["reason"].isin(_NOT_MOLECULES).to_numpy()
    return np.asarray(measured.positions_px[candidates])


def _sample(traces: NDArray[np.floating], pedestal_e: float) -> Sample:
    return Sample(traces, dynamics(traces - pedestal_e))


def _cut(values: NDArray[np.floating], pedestal_e: float, window: int | None) -> Sample:
    dyn = dynamics(values - pedestal_e)
    if window is None:
        return Sample(values, dyn)
    start = windows(dyn, window)
    rows = np.flatnonzero(start >= 0)
    return _sample(np.array([values[i, start[i] : start[i] + window] for i in rows]).reshape(-1, window), pedestal_e)


def _best(sample: Sample, pedestal_e: float, share: float) -> Sample:
    """That share of highest SNR, of any one at least, by what the window shows, not by what came before it."""
    if share == 1:
        return sample
    n = max(1, round(share * len(sample.traces)))
    return _sample(sample.traces[np.argsort(-sample.dynamics.snr, kind="stable")[:n]], pedestal_e)


def _compare(
    samples: dict[str, Sample], model: Model, unit: str, seed: int, n_bootstrap: int, fitted: Fit | None,
    measured: TraceSet | None, notes: tuple[str, ...],
) -> Comparison:  # fmt: skip
    rng = np.random.default_rng(seed)
    real = samples["measured"].traces
    w1: dict[str, Any] = {}
    w1_traces: dict[str, Any] = {}
    interval = {}
    for name, sample in samples.items():
        if name == "measured":
            continue
        if len(sample.traces) == 0:
            w1[name] = w1_traces[name] = None
            continue
        w1[name] = wasserstein(real, sample.traces)
        w1_traces[name] = wasserstein(real, sample.traces, rows="traces")
        interval[name] = bootstrap_interval(real, sample.traces, n=n_bootstrap, rng=rng)
    bottom = floor(real, rng=rng)
    w1 |= {"floor": bottom.value, "unit": f"{unit} per frame"}
    w1_traces |= {"floor": floor(real, rows="traces", n_splits=20, rng=rng).value, "unit": f"{unit}, whole traces"}
    shown = {name: s for name, s in samples.items() if len(s.traces)}
    curves = distributions(shown, unit, model.acquisition.interval_s)
    notes += tuple(
        f"{name}: W1 rests on {checks.counted(len(s.traces), 'trace')}; give more (a larger best, n_simulated or movie)"
        for name, s in samples.items()
        if 0 < len(s.traces) < FEW_TRACES
    )
    notes = notes if fitted is None else (*notes, *fitted.notes)
    found = Comparison(w1, w1_traces, interval, bottom, samples, curves, model, fitted, measured, notes)
    if fitted is not None and found.nearer == "mufasa":
        found = replace(found, notes=(*notes, FIT_FAILED))
    return found


def _most_frequent(measured: TraceSet) -> str:
    reasons = measured.molecules["reason"].str.replace(r"[\d.]+", "…", regex=True).value_counts()
    return "none found" if reasons.empty else f"mostly: {reasons.index[0]}"


class _Steps:
    """Counts whole steps for the progress bar and stops between them."""

    def __init__(self, progress: Progress | None, total: int, cancel: Cancel | None) -> None:
        self.progress, self.total, self.cancel, self.n = progress, total, cancel, 0

    def done(self) -> None:
        self.n += 1
        if self.progress is not None:
            self.progress(self.n, self.total)
        if self.cancel is not None and self.cancel():
            raise Cancelled
