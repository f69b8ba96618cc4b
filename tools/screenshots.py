"""Pictures of every step of the viewer, dark and light, into docs/images.

    xvfb-run -a -s "-screen 0 1600x1000x24" python tools/screenshots.py [--out DIR] [--only NAME …] [--theme dark|light]

Drives the real widgets, as a user would. `real` needs the measurement beside the project (../shared/data); without
it that picture is left out.
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
    workflow.show_step(1)
    yield "2-camera"
    workflow.show_step(2)
    press(workflow.step("Denoise"))
    yield "3-denoise"
    viewer.layers["hidden effect, photons"].visible = False
    workflow.show_step(3)
    molecules = workflow.step("Molecules")
    press(molecules)
    kept = molecules.traces.molecules.query("kept").sort_values("snr").index
    click_molecule(viewer, molecules, int(kept[-1]))
    yield "4-molecules"
    workflow.show_step(4)
    workflow.step("Model").effects.add("stage_drift")
    settle(workflow)
    yield "5-model"
    workflow.step("Model").effects.remove_button.click()
    workflow.show_step(5)
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
    workflow.show_step(6)
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


def real(viewer: Any, workflow: Any) -> Iterator[str]:
    """The real movie: opened, molecules found, one clicked."""
    workflow.step("Data").open_movie(str(REAL_MOVIE))
    finish(workflow.step("Data"))
    workflow.step("Model").source.value = REAL_MODEL
    workflow.step("Data").use_scale.click()
    workflow.show_step(3)
    panel = workflow.step("Molecules")
    press(panel)
    print(f"real movie: {panel.run_bar.message.text()}")
    table = panel.traces.molecules
    good = table[table["kept"] & table["bleaching_frame"].between(100, 500)].sort_values("snr").index
    pump(0.6)
    click_molecule(viewer, panel, int(good[-1]))
    yield "real-movie"


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
    parser.add_argument("--only", nargs="*", choices=["story", "simulate", "design", "real"], default=[])
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
    }
    for name, (widget, scene) in scenes.items():
        if args.only and name not in args.only:
            continue
        if name == "real" and not REAL_MOVIE.is_file():
            print("real movie: not there, left out")
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
                print(f"{path.name}: {path.stat().st_size // 1000} kB")
        viewer.close()
    return 0


if __name__ == "__main__":
    sys.exit(main())
