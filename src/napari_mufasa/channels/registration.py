"""Two channels of one camera and the map between them, from beads or molecules that both show: `register`
(docs/two_channels.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, get_args

import numpy as np
from numpy.typing import NDArray

from napari_mufasa import checks
from napari_mufasa.camera.frames import Frames, Progress
from napari_mufasa.channels import matching
from napari_mufasa.channels.rectangle import Rectangle, check_apart, rectangle
from napari_mufasa.channels.transform import Array, Estimate, Kind, Transform, rms_px
from napari_mufasa.errors import MufasaError
from napari_mufasa.files.whole import PathLike, read_json, write_json
from napari_mufasa.provenance import made_by
from napari_mufasa.spots import drift, find, locate

if TYPE_CHECKING:
    from napari_mufasa.model.setup import Camera

MOVED_PX = 0.3  # of beads while they were recorded: their mean image is smeared
COVERED = 0.5  # of the donor's channel; what lies outside of the beads is extrapolated
KEYS = ("donor", "acceptor", "frame_px", "transform", "donor_px", "acceptor_px", "left_out_px", "found")


@dataclass(frozen=True)
class Channels:
    """Where donor and acceptor are on the camera, and which place of one is which of the other.

    Places are (y, x) in px from the first pixel of their own rectangle.

    Attributes
    ----------
    donor, acceptor : their rectangles; frame_px : (height, width) of the whole frames
    transform : maps places of the donor's channel to places of the acceptor's
    donor_px, acceptor_px : (bead, 2) the spots that match
    left_out_px : (bead, 2) found minus mapped, by the transform of all other beads
    found : spots found in the donor's channel and in the acceptor's
    notes : what the user should know, in sentences
    """

    donor: Rectangle
    acceptor: Rectangle
    frame_px: tuple[int, int]
    transform: Transform
    donor_px: Array
    acceptor_px: Array
    left_out_px: Array
    found: tuple[int, int]
    notes: tuple[str, ...] = ()

    @property
    def residual_px(self) -> Estimate:
        """Root mean square distance between the place found and the one mapped of a bead that was left out."""
        return rms_px(self.left_out_px, self.transform.freedom)

    def summary(self) -> dict[str, Estimate]:
        """Residual, shift at the centre of the beads (acceptor minus donor, each from its own corner), rotation,
        scale."""
        (shift_y, shift_x), map_ = self.transform.shift_px, self.transform
        return {
            "residual_px": self.residual_px, "shift_y_px": shift_y, "shift_x_px": shift_x,
            "rotation_deg": map_.rotation_deg, "scale": map_.scale,
        }  # fmt: skip

    def check_fits(self, movie: Any) -> None:
        """Raise `MufasaError` for a movie whose frames are not those that were registered."""
        shape = tuple(int(n) for n in checks.stack(movie, single=True).shape[1:])
        if shape != self.frame_px:
            was, now = (f"{height} × {width} px" for height, width in (self.frame_px, shape))
            raise MufasaError(
                f"the channels were registered on frames of {was}, the movie's are {now}: "
                "give the whole frames, or register anew"
            )

    def to_dict(self) -> dict[str, Any]:
        """As plain data, with the numbers of `summary` beside."""
        summary = {name: {"value": e.value, "interval_95": [e.low, e.high]} for name, e in self.summary().items()}
        return {
            "donor": str(self.donor), "acceptor": str(self.acceptor), "frame_px": self.frame_px,
            "matched": len(self.donor_px), "found": self.found, "summary": summary,
            "transform": self.transform.to_dict(), "donor_px": self.donor_px, "acceptor_px": self.acceptor_px,
            "left_out_px": self.left_out_px, "notes": self.notes, "program": "napari-mufasa", **made_by(),
        }  # fmt: skip

    def to_json(self, path: PathLike) -> None:
        """Write channels.json, whole or not at all."""
        write_json(path, self.to_dict())

    @classmethod
    def from_json(cls, path: PathLike) -> Channels:
        """Read channels.json; raises `MufasaError` in one line where it is none."""
        data = read_json(path, "a channels.json, which register writes")
        missing = [name for name in KEYS if not isinstance(data, dict) or name not in data]
        if missing:
            raise MufasaError(f"{path} is no channels.json (it has no {missing[0]}): make it with register")
        try:
            frame = (int(data["frame_px"][0]), int(data["frame_px"][1]))
            beads = [np.array(data[name], dtype=float) for name in ("donor_px", "acceptor_px", "left_out_px")]
            found = (int(data["found"][0]), int(data["found"][1]))
            sides = [rectangle(str(data[name]), frame) for name in ("donor", "acceptor")]
            transform = Transform.from_dict(data["transform"])
        except MufasaError as error:
            raise MufasaError(f"{path}: {error}") from None
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise MufasaError(f"{path} is no channels.json ({error!r}): make it anew with register") from None
        if any(each.ndim != 2 or each.shape != (len(beads[0]), 2) or len(each) < 2 for each in beads):
            raise MufasaError(f"{path} has beads that are no places (bead, 2): make it anew with register")
        check_apart(sides[0], sides[1])
        return cls(
            sides[0],
            sides[1],
            frame,
            transform,
            beads[0],
            beads[1],
            beads[2],
            found,
            tuple(map(str, data.get("notes", ()))),
        )


def register(
    beads: Any,
    donor: str | Rectangle = "left",
    acceptor: str | Rectangle = "right",
    *,
    kind: Kind | None = None,
    sigma_px: float | None = None,
    progress: Progress | None = None,
    cancel: Callable[[], bool] | None = None,
) -> Channels:
    """Find the map from the donor's channel to the acceptor's from spots that both show.

    Parameters
    ----------
    beads : (frame, y, x) whole frames of beads that shine in both channels, or of the movie itself where its molecules
        do; one image (y, x) will do. In any unit. Found are the spots of the mean image that stand alone
    donor, acceptor : "left", "right", "top", "bottom", or "Y0:Y1,X0:X1" in pixels
    kind : "affine" or "polynomial" (second order); None: the second order where the beads show it
    sigma_px : width of a spot; None measures it in each channel
    progress : called with (frames read, frames to read); cancel : True stops (raises `Cancelled`)

    Returns
    -------
    Channels : rectangles and transform, with residual and intervals; `to_json` keeps it

    Raises
    ------
    MufasaError : rectangles that the frames do not hold or that overlap, or too few spots that match.
    """
    stack = checks.stack(beads, "beads", single=True)
    frame = (int(stack.shape[1]), int(stack.shape[2]))
    sides = rectangle(donor, frame), rectangle(acceptor, frame)
    check_apart(*sides)
    if kind is not None:
        checks.choice(kind, "kind", get_args(Kind))
    if sigma_px is not None:
        checks.number(sigma_px, "sigma_px", 0.3, 50)
    done = 0

    def report(n: int) -> None:
        nonlocal done
        done += n
        if progress is not None:
            progress(min(done, 4 * len(stack)), 4 * len(stack))

    places, notes = [], []
    for name, side in zip(("donor", "acceptor"), sides, strict=True):
        found, moved = _lone_spots(side.crop(stack), sigma_px, name, report, cancel)
        places.append(found)
        if moved > MOVED_PX:
            notes.append(f"the beads of the {name}'s channel move by {moved:.1f} px while they are recorded")
    return from_places(places[0], places[1], sides[0], sides[1], frame, kind=kind, notes=tuple(notes))


def from_places(
    donor_px: NDArray[np.floating], acceptor_px: NDArray[np.floating], donor: Rectangle, acceptor: Rectangle,
    frame_px: tuple[int, int], *, kind: Kind | None = None, notes: tuple[str, ...] = (),
) -> Channels:  # fmt: skip
    """The same from places (spot, 2) of spots in the two channels, each from its own corner, clearest first; either
    may hold spots that the other does not."""
    places = [np.asarray(each, dtype=float).reshape(-1, 2) for each in (donor_px, acceptor_px)]
    pairs, transform, left_out = matching.match(places[0], places[1], kind)
    matched = places[0][pairs[:, 0]], places[1][pairs[:, 1]]
    covered = _hull_px2(matched[0]) / float(np.prod(donor.shape_px))
    if covered < COVERED:
        notes = (*notes, f"the beads span {covered:.0%} of the donor's channel; outside of them the map is a guess")
    return Channels(donor, acceptor, frame_px, transform, *matched, left_out, (len(places[0]), len(places[1])), notes)


def _lone_spots(
    movie: Any, sigma_px: float | None, name: str, report: Callable[[int], None], cancel: Callable[[], bool] | None
) -> tuple[Array, float]:
    """Places (spot, 2) of spots that stand alone in the mean of a movie, clearest first; how far they move, px."""
    frames = Frames(movie, _any_camera(), unit="photoelectrons")  # places do not depend on the unit
    sigma = sigma_px or find.estimate_sigma_px(frames)
    if sigma is None:
        raise MufasaError(f"no spot stands out in the {name}'s channel: check the rectangle, or record brighter beads")
    seen = find.find_spots(frames, sigma, report=report, cancel=cancel)
    total = np.zeros(frames.shape[1:])
    for _, block in frames.blocks(report=report, cancel=cancel):
        total += block.sum(axis=0, dtype=np.float64)
    mean = (total / frames.n_frames).astype(np.float32)
    start, last = seen.positions_px, np.array(mean.shape) - 1
    pixel = np.clip(np.rint(start).astype(np.int64), 0, last)
    places, good = locate.fit_places(mean[None], np.zeros(len(pixel), np.int64), pixel, sigma, start - pixel)
    alone = seen.is_spot & (find.neighbour_px(start, seen.is_spot) >= find.isolation_px(sigma))
    inside = good & alone & np.all((places >= sigma) & (places <= last - sigma), axis=1)
    clearest = np.argsort(-seen.significance, kind="stable")
    few = frames.n_frames < 2
    return places[clearest[inside[clearest]]], 0.0 if few else drift.moved_px(seen.evidence.early, seen.evidence.late)


def _any_camera() -> Camera:
    from napari_mufasa.model.presets import preset

    return preset("FF").camera


def _hull_px2(places_px: Array) -> float:
    from scipy.spatial import ConvexHull

    return float(ConvexHull(places_px).volume)
