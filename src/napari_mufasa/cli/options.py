"""Arguments and options that several verbs share.

The words an option may take stand here once more, because they are read before anything heavy is imported; a test
holds them to those of the functions they are handed to.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

EngineName = Literal["fast", "exact"]
SnrBy = Literal["power", "exposure"]
CameraName = Literal["CCD", "EMCCD", "CMOS"]
UnitName = Literal["photoelectrons", "photons", "adu"]
ProfileName = Literal["psf", "sum", "brightest_pixel"]
ThresholdName = Literal["sigma", "percentile", "otsu", "triangle"]
TimesName = Literal["model", "tool"]
KindName = Literal["affine", "polynomial"]
FindInName = Literal["sum", "donor"]
MethodName = Literal["pure-let", "pure-let-movie", "pure-let-patches", "source", "none"]

MovieFile = Annotated[
    Path, typer.Argument(metavar="MOVIE", help="TIFF, zarr, .nd2, .sif, .czi, .lif or .pma: (frame, y, x).")
]
ModelFile = Annotated[Path, typer.Option("--model", metavar="MODEL.json", help="The model (see 'presets').")]
DarkFile = Annotated[Path | None, typer.Option("--dark", metavar="DARK", help="Frames without light.")]
OutFolder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write into.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that are there already.")]
Resume = Annotated[
    bool, typer.Option("--resume", help="Keep finished blocks when interrupted, and go on from those of the same run.")
]
Seed = Annotated[int, typer.Option("--seed", min=0, metavar="N", help="The same seed gives the same result.")]
Scheduler = Annotated[
    str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Work on a Dask cluster, as tcp://host:8786.")
]
Budget = Annotated[
    int | None,
    typer.Option(min=1, metavar="N", help="Simulations that may be spent; 5000 without it, fewer for large movies."),
]

Channel = Annotated[
    str | None,
    typer.Option("--channel", metavar="RECT", help="One part of the frames: left, right, top, bottom or Y0:Y1,X0:X1."),
]

# which molecules of a movie
Window = Annotated[
    int | None, typer.Option("--window", min=1, metavar="N", help="Keep N frames just before each bleaching.")
]
Best = Annotated[int | None, typer.Option("--best", min=1, metavar="N", help="Keep the N best molecules.")]
MaxSteps = Annotated[
    int | None, typer.Option("--max-steps", min=0, metavar="N", help="At most N bleaching steps (1: single molecules).")
]
FollowDrift = Annotated[bool, typer.Option("--follow-drift", help="Let positions follow the motion of the field.")]

FollowMolecules = Annotated[
    bool, typer.Option("--follow-molecules", help="Follow each molecule from frame to frame; tell its diffusion.")
]
MaxStep = Annotated[
    float | None, typer.Option("--max-step", min=0.01, metavar="PX", help="Farthest step of a followed molecule (2 σ).")
]
MaxGap = Annotated[
    int | None, typer.Option("--max-gap", min=0, metavar="N", help="Frames a followed molecule may be missed for (5).")
]

# two channels
ChannelsFile = Annotated[
    Path | None,
    typer.Option("--channels", metavar="channels.json", help="Read donor and acceptor, as 'register' found them."),
]
FindIn = Annotated[
    FindInName | None, typer.Option("--find-in", help="Where molecules are looked for: both channels together, or one.")
]
Leakage = Annotated[
    float, typer.Option("--leakage", min=0, max=1, metavar="L", help="Share of the donor's light seen as acceptor's.")
]
DirectExcitation = Annotated[
    float, typer.Option("--direct-excitation", min=0, metavar="E", help="Photoelectrons per frame, of the acceptor.")
]
Gamma = Annotated[
    float, typer.Option("--gamma", min=0.01, max=100, metavar="G", help="Detection of acceptor over donor.")
]
AcceptorSigma = Annotated[
    float | None, typer.Option("--acceptor-sigma", min=0.3, max=50, metavar="PX", help="PSF there, if not the model's.")
]

# what a table of traces holds
TraceUnit = Annotated[UnitName | None, typer.Option("--unit", help="Of the traces; default: as the file says.")]
TraceProfile = Annotated[
    ProfileName | None, typer.Option("--profile", help="What each trace holds; default: psf, TIFF: brightest_pixel")
]
TraceBackground = Annotated[
    bool | None,
    typer.Option(
        "--with-background/--without-background", help="Is the background in the traces? Default: in a TIFF only."
    ),
]
