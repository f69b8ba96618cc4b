"""Results in lines of text: a comparison, a molecule, a design that was solved, where a model fails."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from napari_mufasa.checks import counted
from napari_mufasa.report.fields import label_of, number_text, told

if TYPE_CHECKING:
    from collections.abc import Sequence

    from napari_mufasa.calibrate import Calibration
    from napari_mufasa.channels import Channels, PairedTraces
    from napari_mufasa.compare import Comparison
    from napari_mufasa.compare.wasserstein import Floor
    from napari_mufasa.design.solve import Solution
    from napari_mufasa.propose import Mismatch, Proposal


def movie_facts(name: str, shape: tuple[int, ...], dtype: Any, size_um: float | None, carried: str) -> str:
    """What is known about a movie (frame, y, x), as HTML; `carried`: about the model in its metadata."""
    frames, height, width = shape
    size = f"pixel size {size_um * 1000:.4g} nm" if size_um else "pixel size not stated: the model's is used"
    return f"<b>{name}</b>: {counted(frames, 'frame')} of {height} × {width} px, {dtype}<br>{size}<br>{carried}"


def instrument_line(known: dict[str, Any]) -> str:
    """What the recording software wrote, with units."""
    words = {
        "pixel_size_nm": ("pixel size", "nm", 1.0), "exposure_s": ("exposure", "ms", 1e3),
        "interval_s": ("frame every", "ms", 1e3), "em_gain": ("EM gain setting", "", 1.0),
        "gain": ("gain (of what is not said)", "", 1.0), "register": ("EM register", "", 1.0),
        "camera": ("camera", "", 1.0),
        "preamp_gain": ("preamplifier", "", 1.0), "readout_rate_hz": ("read-out", "MHz", 1e-6),
        "bit_depth": ("depth", "bit", 1.0), "baseline_adu": ("baseline setting", "ADU", 1.0),
    }  # fmt: skip
    told = []
    for name, value in known.items():
        word, unit, factor = words[name]
        told.append(f"{word} {value if isinstance(value, str) else f'{value * factor:.5g}'} {unit}".rstrip())
    return ", ".join(told)


def calibration_line(found: Calibration, movie: str) -> str:
    """What was measured of a camera, and on which movie."""
    return (
        f"Measured on {movie}: {found.adu_per_photoelectron} ADU per photoelectron, baseline {found.baseline_adu} ADU, "
        f"read noise {found.read_noise_adu} ADU."
    )


def fit_line(found: Calibration) -> str:
    """Whether the law of the camera fits its histograms."""
    if not found.fits:
        return "No test of fit: too few counts."
    elsewhere = ", ".join(f"{fit.name} {100 * fit.distance:.2g} %" for fit in found.fits)
    verdict = "the law holds" if found.law_holds else "the law is not all there is"
    return f"Test of fit: {verdict} (p = {found.p_value:.2g}); counts elsewhere than it says: {elsewhere}."


def solution_lines(found: Solution) -> list[str]:
    """Where targets of a design are met: one line for the value set, one for each target, one for all together."""
    lines = [f"{told(found.vary.split('.')[1])} = {found.value:.4g}"]
    for name, wanted in found.targets.items():
        reached = getattr(found.prediction, name)
        is_met = "met" if found.met[name] else "missed"
        gives = "none" if reached is None else f"{reached:.4g}"
        lines.append(f"{told(name)}: {gives}, wanted {wanted:g}: {is_met}; met at {_stretches(found.ranges[name])}")
    if len(found.targets) > 1:
        if found.together:
            lines.append(f"all met at {_stretches(found.together)}")
        else:
            lines.append("not all at once: no value of this one number meets every target; change another one, too")
    return lines


def _stretches(ranges: tuple[tuple[float, float], ...]) -> str:
    return " and ".join(f"{low:.4g} … {high:.4g}" for low, high in ranges) or "no value"


def proposal_lines(found: Proposal, movie: str) -> str:
    """What a model proposed from a movie rests on: values with intervals, what is not known, what to note, as HTML."""
    rows = []
    for name, value in found.values.items():
        low, high = value.interval
        known = f"{value.value:.4g}" + (f" ({low:.3g} … {high:.3g})" if np.isfinite(low) else " (not measured)")
        rows.append(f"<tr><td>{told(name.split('.')[-1])}&nbsp;&nbsp;</td><td>{known}</td></tr>")
    unknown = "".join(f"<br>{label_of(name.split('.')[-1])}: {words}" for name, words in found.unknown.items())
    notes = "".join(f"<br>{note}" for note in found.notes)
    told_unknown = f"<b>Not known</b>{unknown}" if unknown else ""
    head = f"<b>Proposed</b> from {escape(movie)} (95 % interval)"
    return f"{head}<table>{''.join(rows)}</table>{told_unknown}{notes}"


def mismatch_line(origin: str, found: Sequence[Mismatch]) -> str:
    """A warning that the model believed cannot be the movie's, as HTML; nothing where nothing speaks against it."""
    if not found:
        return ""
    named = f" ({origin})" if origin else ""
    said = "".join(f"<br>{mismatch.words}" for mismatch in found)
    return f"<b>The model believed{named} cannot be this movie's.</b>{said}<br>Step Camera can propose one."


def comparison_table(comparison: Comparison) -> str:
    """Every model's distance to the measurement with its interval, and the floor, as HTML."""
    from napari_mufasa.report.plots.emission import MODELS

    rows = []
    for name in ("mufasa", "fitted", "poisson", "sofi"):
        if comparison.w1.get(name) is not None:
            low, high = comparison.w1_interval[name]
            words = f"{number_text(round(comparison.w1[name], 2))} ({low:.2f} … {high:.2f})"
            rows.append(f"<tr><td>{MODELS[name]}&nbsp;&nbsp;</td><td><b>{words}</b></td></tr>")
    floor, molecules = comparison.floor, len(comparison.samples["measured"].traces)
    rows.append(f"<tr><td>floor</td><td>{floor.value:.2f} ({floor.low:.2f} … {floor.high:.2f})</td></tr>")
    head = f"W1 distance in {comparison.w1['unit']}, {molecules} molecules (95 % interval)"
    return f"{head}<table>{''.join(rows)}</table>" + "".join(f"<br>{note}" for note in comparison.notes)


def molecule_line(row: Any) -> str:
    """A row of a table of molecules, as HTML."""
    verdict = "kept" if row["kept"] else f"rejected: {row['reason']}"
    bleached = int(row["bleaching_frame"])
    moves = ""
    if "diffusion_px2_per_frame" in row:
        moves = (
            f"found in {row['found_frames']} frames, D {row['diffusion_px2_per_frame']:.2g} ± "
            f"{row['diffusion_sd_px2_per_frame']:.1g} px² per frame, drift y {row['drift_y_px_per_frame']:.2g}, "
            f"x {row['drift_x_px_per_frame']:.2g} ± {row['drift_sd_px_per_frame']:.1g} px per frame · "
        )
    ratio = ""
    if "efficiency" in row:
        ratio = f"E {row['efficiency']:.3f} ± {row['efficiency_sd']:.3f} · "
    return (
        f"<b>Molecule {row['molecule']}</b> at y {row['y_px']:.1f}, x {row['x_px']:.1f} px · {moves}"
        f"{ratio}{row['brightness']:.0f} e⁻ per frame, SNR {row['snr']:.1f} · "
        f"{f'bleached at frame {bleached}' if bleached >= 0 else 'not bleached'} · {verdict}"
    )


def moving_line(found: Any) -> str:
    """How the kept molecules of a `TraceSet` move that were followed, in the middle and in the middle half of them."""
    kept = found.molecules[found.kept]
    told = []
    for column, word in (("found_frames", "found in {} frames"), ("diffusion_px2_per_frame", "D {} px² per frame")):
        values = kept[column].dropna()
        if len(values):
            low, middle, high = (f"{v:.3g}" for v in values.quantile([0.25, 0.5, 0.75]))
            told.append(word.format(f"{middle} ({low} … {high})"))
    return "followed molecules: " + (", ".join(told) if told else "none was kept")


def channels_lines(found: Channels) -> list[str]:
    """What two channels were registered with: matches, residual, shift, rotation, scale, notes."""
    numbers, (donors, acceptors) = found.summary(), found.found
    order = "affine" if found.transform.kind == "affine" else "polynomial of second order"
    return [
        f"{len(found.donor_px)} spots match of {donors} in the donor's channel and {acceptors} in the acceptor's; "
        f"{order}",
        f"left out, a spot is {numbers['residual_px']} px from its mapped place (root mean square, 95 % interval)",
        f"shift y {numbers['shift_y_px']}, x {numbers['shift_x_px']} px, rotation {numbers['rotation_deg']}°, "
        f"scale {numbers['scale'].value:.4f} ({numbers['scale'].low:.4f} … {numbers['scale'].high:.4f})",
        *(f"note: {note}" for note in found.notes),
    ]


def efficiency_line(found: PairedTraces) -> str:
    """The efficiencies of the kept molecules, in the middle and in the middle half of them, and what they are."""
    values = found.molecules["efficiency"][found.kept].dropna()
    if not len(values):
        return "no molecule kept, so no efficiency"
    low, middle, high = (f"{v:.3f}" for v in values.quantile([0.25, 0.5, 0.75]))
    corrections = found.corrections
    what = (
        "apparent: leakage and direct excitation not corrected"
        if corrections.none
        else (
            f"leakage {corrections.leakage:g}, direct excitation {corrections.direct_excitation_e:g} e⁻ per frame, "
            f"γ {corrections.gamma:g}"
        )
    )
    return f"efficiency E {middle} (middle half {low} … {high}; {what})"


def map_line(layer: str, z: NDArray[Any], where: str) -> str:
    """What a map of misfit (in sd) shows; `where`: its worst stretch, if it has any."""
    off = float((np.abs(z) > 4).mean())
    return (
        f"Layer “{layer}”: measured − model in sd (green more, pink less); "
        f"{off:.1%} of the pixels are more than 4 sd off{where}."
    )


def molecules_line(layer: str, table: Any, number: str) -> str:
    """What a layer of molecules coloured by their misfit in a number (a column of `Places.molecules`) shows."""
    z = table[number].to_numpy(float)
    worst = table.iloc[int(np.argmax(np.abs(z)))]
    return (
        f"Layer “{layer}”: each molecule against the model's (green more, pink less); "
        f"{int((np.abs(z) > 3).sum())} of {len(z)} are more than 3 sd off, farthest at "
        f"y {worst['y_px']:.0f}, x {worst['x_px']:.0f} px."
    )


def w1_rows(comparison: Comparison) -> list[tuple[str, str | None]]:
    """Every model's distance to the measurement with its 95 % interval, and the floor with that of its splits."""
    bottom, rows = comparison.floor, list[tuple[str, str | None]]()
    for name, value in comparison.w1.items():
        if name == "floor":
            known = f"{bottom.value:.4g} [{bottom.low:.4g}, {bottom.high:.4g}]"
            rows.append((name, known if np.isfinite(bottom.value) else "too few molecules for a floor"))
        elif name != "unit":
            interval = comparison.w1_interval.get(name)
            rows.append((name, None if interval is None else f"{value:.4g} [{interval[0]:.4g}, {interval[1]:.4g}]"))
    return rows


def live_line(w1: float, floor: Floor, busy: bool) -> str:
    """The distance of a model that is being edited, as HTML."""
    # A model at the floor scores anything up to about the largest distance of two halves.
    at = " – at the floor" if w1 <= floor.high else f" – {w1 / max(floor.value, 1e-9):.1f} × the floor"
    return f"W1 now <b>{w1:.2f}</b>, floor {floor.value:.2f} e⁻ per frame{at}{' …' if busy else ''}"
