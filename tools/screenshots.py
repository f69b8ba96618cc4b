"""Pictures of every step of the viewer, dark and light, into docs/images.

    xvfb-run -a -s "-screen 0 1600x1000x24" python tools/screenshots.py [--out DIR] [--only NAME …] [--theme dark|light]

Drives the real widgets, as a user would; steps are asked for by their names. `real` and `proposed` need the
measurement beside the project (../shared/data); without it those pictures are left out. At the end it says which
pictures of the folder no scene makes any more.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
REAL_MOVIE = ROOT.parent / "shared" / "data" / "smfret_ixon_emccd.tif"
REAL_MODEL = ROOT / "docs" / "models" / "smfret_ixon.json"
MAX_BYTES = 250_000
SUSPECTS: list[str] = []


def pump(seconds: float = 0.4) -> None:
    """Let the interface draw."""
    from qtpy.QtWidgets import QApplication

    end = time.monotonic() + seconds
    while time.monotonic() < end:
        QApplication.processEvents()
        time.sleep(0.005)


def finish(panel: Any) -> None:
    """Wait for the run under way."""
    while panel.run_bar.running:
        pump(0.05)


def press(panel: Any) -> None:
    panel.run_bar.run_button.click()
    finish(panel)


def click_molecule(viewer: Any, panel: Any, index: int) -> None:
    """A real mouse click on a molecule in the canvas."""
    from qtpy.QtCore import QPoint, Qt
    from qtpy.QtTest import QTest

    points = panel.points
    viewer.layers.selection.active = points
    pump()
    canvas = viewer.window._qt_viewer.canvas
    world = points.data_to_world(points.data[index])
    camera = viewer.scene.camera if hasattr(viewer, "scene") else viewer.camera
    height, width = canvas.size
    y = height / 2 + (world[-2] - camera.center[-2]) * camera.zoom
    x = width / 2 + (world[-1] - camera.center[-1]) * camera.zoom
    QTest.mouseClick(canvas.native, Qt.MouseButton.LeftButton, pos=QPoint(round(x), round(y)))
    pump()
    if panel.shown != index:
        raise RuntimeError(f"clicked molecule {index}, the panel shows {panel.shown}")


def story(viewer: Any, workflow: Any) -> Iterator[str]:
    """The workflow on the hidden-effect sample; yields the name of each picture when it is ready."""
    data = workflow.step("Data")
    data.sample_button.click()
    finish(data)
    pump(0.8)
    yield "1-data"
    show(workflow, "Camera")
    yield "2-camera"
    show(workflow, "Denoise")
    press(workflow.step("Denoise"))
    yield "3-denoise"
    viewer.layers["hidden effect, photons"].visible = False
    show(workflow, "Molecules")
    molecules = workflow.step("Molecules")
    press(molecules)
    kept = molecules.traces.molecules.query("kept").sort_values("snr").index
    click_molecule(viewer, molecules, int(kept[-1]))
    yield "4-molecules"
    show(workflow, "Model")
    workflow.step("Model").effects.add("stage_drift")
    settle(workflow)
    yield "5-model"
    workflow.step("Model").effects.remove_button.click()
    show(workflow, "Compare")
    compare = workflow.step("Compare")
    press(compare)
    yield "6-compare"
    compare.tabs.setCurrentIndex(1)
    yield "6-compare-distributions"
    compare.tabs.setCurrentWidget(compare.live)
    settle(workflow)
    yield "6-compare-live"
    compare.tabs.setCurrentWidget(compare.traces)
    yield "6-compare-traces"
    yield from discover(workflow)


def discover(workflow: Any) -> Iterator[str]:
    show(workflow, "Discover")
    panel = workflow.step("Discover")
    if SUSPECTS:
        choose_suspects(panel.suspects)
    press(panel)
    show_a_map(panel)
    yield "7-discover-where"
    panel.where.in_image.setChecked(False)
    panel.tabs.setCurrentIndex(1)
    yield "7-discover-what"
    if panel.what.add_button.isEnabled():
        panel.what.add_button.click()
        finish(panel)
    panel.tabs.setCurrentIndex(2)
    yield "7-discover-error"


def choose_suspects(suspects: Any) -> None:
    """Tick those that were named on the command line, and no other."""
    from qtpy.QtCore import Qt

    suspects.none_button.click()
    for row in range(suspects.list.count()):
        item = suspects.list.item(row)
        if item.data(Qt.ItemDataRole.UserRole) in SUSPECTS:
            item.setCheckState(Qt.CheckState.Checked)


def show_a_map(panel: Any) -> None:
    """Choose the first observable whose place is a map of the field."""
    for row in range(panel.where.failing.rowCount()):
        panel.where.failing.selectRow(row)
        panel.where.failing.cellClicked.emit(row, 0)
        pump(0.1)
        if panel.layers.get("map") is not None and panel.layers.get("map").visible:
            return
    panel.where.failing.selectRow(0)


def settle(workflow: Any) -> None:
    """Wait for the live distance."""
    from napari_mufasa.widgets.turns.live import live_of

    pump(0.4)
    while live_of(workflow.session).busy:
        pump(0.05)


def simulate(viewer: Any, dock: Any) -> Iterator[str]:
    panel = dock.panel
    panel.form.model.value = "FF"
    power = panel.parts["excitation"].form["power_density_w_per_cm2"].native
    power.setText("10")
    power.editingFinished.emit()
    press(panel)
    viewer.layers[-1].visible = True
    yield "simulate"


def design(viewer: Any, dock: Any) -> Iterator[str]:
    press(dock.panel)
    yield "design"
    from napari_mufasa.widgets.parts.pieces import into_view

    dock.panel.power_section.expand(animate=False)
    asked = dock.panel.hidden_effect
    asked.strengths.value, asked.movies.value = (0.4, 0.8, 1.6, 3.2), 20
    dock.panel.power_button.click()
    finish(dock.panel)
    into_view(dock.panel.power_plot)
    yield "design-power"


def real(viewer: Any, workflow: Any) -> Iterator[str]:
    """The real movie: opened, molecules found, one clicked."""
    workflow.step("Data").open_movie(str(REAL_MOVIE))
    finish(workflow.step("Data"))
    workflow.step("Model").source.value = REAL_MODEL
    workflow.step("Data").use_scale.click()
    show(workflow, "Molecules")
    panel = workflow.step("Molecules")
    press(panel)
    print(f"real movie: {panel.run_bar.message.text()}")
    table = panel.traces.molecules
    good = table[table["kept"] & table["bleaching_frame"].between(100, 500)].sort_values("snr").index
    pump(0.6)
    click_molecule(viewer, panel, int(good[-1]))
    yield "real-movie"


def proposed(viewer: Any, workflow: Any) -> Iterator[str]:
    """A model proposed from the real movie, scrolled to the picture of its test of fit."""
    workflow.step("Data").open_movie(str(REAL_MOVIE))
    finish(workflow.step("Data"))
    show(workflow, "Camera")
    panel = workflow.step("Camera")
    panel.form.em_gain.value = 300.0
    panel.propose_button.click()
    finish(panel)
    pump(1.0)
    scroll_to(panel.picture)
    yield "camera-proposed"


def channels(viewer: Any, workflow: Any) -> Iterator[str]:
    """A simulated splitter: beads registered, both channels of a molecule."""
    from napari_mufasa.files.layers import movie_space
    from napari_mufasa.widgets.parts.layers import movie_layer

    model, (beads, movie) = splitter()
    whole = model.with_values({"acquisition.shape_px": movie.shape[1:]})
    space = movie_space(whole.acquisition.pixel_size_nm)
    viewer.add_layer(movie_layer(movie, "splitter", space, whole, 1))
    viewer.add_layer(movie_layer(beads, "beads", space))
    data = workflow.step("Data")
    workflow.session.set_movie(viewer.layers["splitter"])
    workflow.session.take_model_of_movie()
    part = data.channels
    part.parentWidget().parentWidget().expand(animate=False)
    part.form.beads.value = viewer.layers["beads"]
    part.draw_button.click()
    part.register_button.click()
    finish(data)
    viewer.reset_view()
    pump(0.6)
    scroll_to(part.said)
    yield "channels-registered"
    viewer.layers["beads"].visible = viewer.layers["beads, channels"].visible = False
    show(workflow, "Molecules")
    panel = workflow.step("Molecules")
    press(panel)
    pump(0.6)
    click_molecule(viewer, panel, int(panel.traces.molecules.query("kept")["efficiency"].sub(0.5).abs().idxmin()))
    yield "channels-molecule"


def splitter() -> tuple[Any, tuple[Any, Any]]:
    """The model of a half, and two movies of whole frames: beads, and molecules whose efficiency switches."""
    import numpy as np

    import napari_mufasa as nm
    from napari_mufasa.channels import simulate_pair

    model = nm.preset("FF").with_values(
        {
            "acquisition.n_frames": 200, "acquisition.shape_px": (128, 96), "excitation.power_density_w_per_cm2": 8,
            "optics.background_photons_per_px": 10, "fluorophore.cycles_before_bleaching": None,
            "sample.n_molecules": 40, "sample.min_distance_px": 11,
        }
    )  # fmt: skip

    def there(places: Any) -> Any:
        turn, centre = np.radians(1.2), np.array([63.5, 47.5])
        linear = 1.01 * np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        return (places - centre) @ linear.T + centre + np.array([2.0, -3.0])

    rng = np.random.default_rng(1)
    high = np.cumsum(rng.random((40, 200)) < 0.03, axis=1) % 2 == 1
    beads = model.with_values({"acquisition.n_frames": 10, "excitation.power_density_w_per_cm2": 60})
    return model, (
        simulate_pair(beads, 0.5, there, seed=1).movie,
        simulate_pair(model, np.where(high, 0.8, 0.25), there, seed=2).movie,
    )


def scroll_to(widget: Any) -> None:
    """Let what scrolls around a widget show it."""
    from qtpy.QtWidgets import QScrollArea

    around = widget.parentWidget()
    while around is not None and not isinstance(around, QScrollArea):
        around = around.parentWidget()
    if around is not None:
        around.ensureWidgetVisible(widget)
    pump(0.3)


def show(workflow: Any, name: str) -> None:
    """A step, by its name."""
    from napari_mufasa.widgets.workflow import STEPS

    workflow.show_step(list(STEPS).index(name))
    pump(0.2)


def drawn(dock: Any) -> None:
    """Wait for the plots, which are drawn in a thread."""
    from napari_mufasa.widgets.parts.plot import PlotCanvas

    while any(canvas.busy for canvas in dock.findChildren(PlotCanvas)):
        pump(0.05)
    pump(0.1)


def compress(path: Path) -> None:
    """256 colours where the picture is too large; fewer greys first, so that camera noise does not use them all up."""
    import numpy as np
    from PIL import Image

    image = Image.open(path).convert("RGB")
    image.save(path, optimize=True)
    if path.stat().st_size < MAX_BYTES:
        return
    pixels = np.asarray(image).astype(int)
    noise = (np.ptp(pixels, axis=-1) <= 2)[..., None]
    coarse = np.where(noise, np.minimum(pixels // 16 * 16 + 8, 255), pixels).astype(np.uint8)
    Image.fromarray(coarse).quantize(256, kmeans=2, dither=Image.Dither.NONE).save(path, optimize=True)
    if path.stat().st_size >= MAX_BYTES:
        raise SystemExit(f"{path} has {path.stat().st_size} bytes, more than {MAX_BYTES}")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images")
    parser.add_argument(
        "--only", nargs="*", choices=["story", "simulate", "design", "real", "proposed", "channels"], default=[]
    )
    parser.add_argument("--theme", choices=["dark", "light"])
    parser.add_argument("--suspects", nargs="*", default=[], help="effects to consider in step Discover (all)")
    args = parser.parse_args()
    SUSPECTS.extend(args.suspects)
    home = tempfile.mkdtemp()
    for name in ("XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        os.environ[name] = home  # nobody's settings in the pictures

    import napari

    args.out.mkdir(parents=True, exist_ok=True)
    scenes: dict[str, tuple[str, Callable[[Any, Any], Iterator[str]]]] = {
        "story": ("MUFASA workflow", story),
        "simulate": ("Simulate", simulate),
        "design": ("Design", design),
        "real": ("MUFASA workflow", real),
        "proposed": ("MUFASA workflow", proposed),
        "channels": ("MUFASA workflow", channels),
    }
    made: set[str] = set()
    for name, (widget, scene) in scenes.items():
        if args.only and name not in args.only:
            continue
        if name in ("real", "proposed") and not REAL_MOVIE.is_file():
            print(f"{name}: the real movie is not there, left out")
            continue
        viewer = napari.Viewer()
        viewer.window.resize(1600, 1000)
        _, panel = viewer.window.add_plugin_dock_widget("napari-mufasa", widget)
        pump(0.6)
        for shot in scene(viewer, panel):
            for theme in ("dark", "light") if args.theme is None else (args.theme,):
                viewer.theme = theme
                pump(0.7)
                drawn(panel)
                path = args.out / f"{shot}-{theme}.png"
                viewer.screenshot(str(path), canvas_only=False, flash=False)
                compress(path)
                made.add(path.name)
                print(f"{path.name}: {path.stat().st_size // 1000} kB")
        viewer.close()
    if not args.only and args.theme is None:
        for path in sorted(args.out.glob("*.png")):
            if path.name not in made:
                print(f"{path.name}: made by no scene")
    return 0


if __name__ == "__main__":
    sys.exit(main())
