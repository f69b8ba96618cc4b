"""Verbs that start from a movie and a camera: denoise, traces, compare, calibrate."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from napari_mufasa.cli import console
from napari_mufasa.cli.making import ModelFile, Seed
from napari_mufasa.errors import MufasaError

MovieFile = Annotated[Path, typer.Argument(metavar="MOVIE", help="TIFF, OME-TIFF or zarr, (frame, y, x).")]
DarkFile = Annotated[Path | None, typer.Option("--dark", metavar="DARK", help="Frames without light.")]
OutFolder = Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder to write into.")]
IN_MEMORY_BYTES = 2**30


def denoise(
    movie: MovieFile,
    model: ModelFile,
    out: Annotated[Path, typer.Option("--out", metavar="OUT", help="OUT.tif or OUT.zarr.")],
    method: Annotated[str | None, typer.Option("--method", metavar="NAME", help="Default: the best one.")] = None,
) -> None:
    """Estimate the light: photons per pixel and frame, float32."""
    import numpy as np

    from napari_mufasa import io
    from napari_mufasa.denoise.pipeline import denoise as run
    from napari_mufasa.model import Model

    console.check_movie_out(out)
    believed = Model.from_json(model)
    source = io.read_movie(movie)
    shape = tuple(int(n) for n in source.data.shape)
    options = {"method": method} if method is not None else {}
    size_nm = believed.acquisition.pixel_size_nm
    with console.scratch(out, shape, np.float32, in_memory=4 * int(np.prod(shape)) <= IN_MEMORY_BYTES) as result:
        with console.working("denoising") as work:
            run(source.data, believed.camera, out=result, **options, **work.both())
        blocks = (result[start : start + 64] for start in range(0, shape[0], 64))
        io.write_movie(out, blocks, shape, np.float32, pixel_size_nm=size_nm)
    typer.echo(f"{out}: {shape[0]} frames of {shape[1]} × {shape[2]} px, photons per pixel and frame")


VERBS = (denoise,)
