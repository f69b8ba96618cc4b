"""How long the interface stands still: a 512 × 512 × 2000 zarr movie opened, scrubbed, and every step run on it.

    make stalls

A heartbeat in the interface's thread notes every gap; a watchdog notes where the interface was when the beat was late.
Bound: the worst gap is at most 150 ms with software rendering, the longest garbage collection in that time taken off:
Python collects when and where it likes, in whatever thread, and a full collection of napari's objects alone takes some
160 ms (measured: 360 000 objects). A plugin must not keep Python from it. Imports and first compilations are excepted:
everything is done once with a small movie before. A step that takes longer than `LONGEST_S` on the large movie is
cancelled, which must free its panel within a second; every step runs to its end on the small one. It is no part of
`make test`, because a busy machine delays an interface that does nothing: that gap is measured and told, too, and so is
what napari alone needs to make and to remove layers. STALL_PARTS (first,small,large), STALL_SHAPE, STALL_LONGEST_S and
STALL_FOLDER (keeps the movies) shorten it.
"""

from __future__ import annotations

import gc
import os
import sys
import threading
import time
import traceback
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from qtpy.QtCore import Qt, QTimer
from qtpy.QtWidgets import QApplication

BOUND_S = float(os.environ.get("STALL_BOUND_S", 0.15))
LONGEST_S = float(os.environ.get("STALL_LONGEST_S", 25))
SHAPE = tuple(int(n) for n in os.environ.get("STALL_SHAPE", "2000,512,512").split(","))
PARTS = os.environ.get("STALL_PARTS", "first,small,large").split(",")
BEAT_MS = 5


class Heart:
    """Gaps between beats of the interface's event loop, by what was going on."""

    def __init__(self) -> None:
        self.worst: dict[str, tuple[float, float]] = {}  # gap, and what the interface itself worked in it
        self.late: dict[str, Counter[str]] = {}
        self.doing = ""
        self.collecting: dict[str, float] = {}  # the longest garbage collection, in whatever thread
        self._collection = 0.0
        gc.callbacks.append(self._collect)
        self._last, self._cpu = time.perf_counter(), time.thread_time()
        self._main = threading.main_thread().ident
        self._stop = threading.Event()
        self._timer = QTimer()
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.setInterval(BEAT_MS)
        self._timer.timeout.connect(self._beat)
        self._timer.start()
        threading.Thread(target=self._watch, daemon=True).start()

    def _beat(self) -> None:
        now, cpu = time.perf_counter(), time.thread_time()
        if self.doing and now - self._last > self.worst.get(self.doing, (0.0, 0.0))[0]:
            self.worst[self.doing] = now - self._last, cpu - self._cpu
        self._last, self._cpu = now, cpu

    def _collect(self, phase: str, _info: dict[str, int]) -> None:
        now = time.perf_counter()
        if phase == "stop" and self.doing:
            self.collecting[self.doing] = max(self.collecting.get(self.doing, 0.0), now - self._collection)
        self._collection = now

    def _watch(self) -> None:
        while not self._stop.wait(0.02):
            if self.doing and time.perf_counter() - self._last > 0.1:
                frame = sys._current_frames().get(self._main)
                if frame is not None:
                    lines = [
                        f"{f.filename.split('site-packages/')[-1].split('/src/')[-1]}:{f.lineno} {f.name}"
                        for f in traceback.extract_stack(frame)
                    ]
                    lines = [line for line in lines if "_pytest" not in line and "pluggy" not in line]
                    self.late.setdefault(self.doing, Counter())[" < ".join(lines[:-9:-1])] += 1
                for thread in threading.enumerate():  # who may hold the interpreter
                    frame = sys._current_frames().get(thread.ident or 0)
                    if frame is None or thread.ident in (self._main, threading.get_ident()):
                        continue
                    where = (
                        f"{frame.f_code.co_filename.split('site-packages/')[-1].split('/src/')[-1]}:{frame.f_lineno}"
                    )
                    if "/threading.py" not in where and "/queue.py" not in where:
                        self.late.setdefault(self.doing, Counter())[f"meanwhile {where} {frame.f_code.co_name}"] += 1

    @contextmanager
    def during(self, what: str) -> Iterator[None]:
        rest()
        self.doing, self._last, self._cpu = what, time.perf_counter(), time.thread_time()
        start = time.perf_counter()
        yield
        rest()
        self.doing = ""
        gap, cpu = self.worst.get(what, (0.0, 0.0))
        took = time.perf_counter() - start
        garbage = self.collecting.get(what, 0.0)
        print(f"{1000 * gap:6.0f} {1000 * cpu:12.0f} {1000 * garbage:10.0f} {took:8.1f}  {what}", flush=True)

    def stop(self) -> None:
        self._timer.stop()
        gc.callbacks.remove(self._collect)
        self._stop.set()


def rest(seconds: float = 0.15) -> None:
    end = time.perf_counter() + seconds
    while time.perf_counter() < end:
        QApplication.processEvents()
        time.sleep(0.001)


def wait_for(condition, most_s: float = 120.0) -> bool:
    end = time.perf_counter() + most_s
    while not condition() and time.perf_counter() < end:
        QApplication.processEvents()
        time.sleep(0.001)
    return bool(condition())


@pytest.fixture(scope="module")
def movies(tmp_path_factory):
    """A large and a small movie on disk, their model in the metadata."""
    from napari_mufasa import files
    from napari_mufasa.samples import puzzle_model
    from napari_mufasa.simulate.movie import SimulatedAcquisition

    folder = Path(os.environ.get("STALL_FOLDER") or tmp_path_factory.mktemp("movies"))
    made = {}
    for name, (frames, *shape) in (("large", SHAPE), ("small", (100, 56, 56))):
        if name == "large" and name not in PARTS:
            continue
        molecules = max(25, int(0.0034 * np.prod(shape)))
        model = puzzle_model().with_values(
            {"acquisition.n_frames": frames, "acquisition.shape_px": tuple(shape), "sample.n_molecules": molecules}
        )
        path = folder / f"{name}-{frames}.zarr"
        made[name] = path
        if path.exists():  # kept by an earlier run
            continue
        # The same few frames again and again: what they show does not matter here.
        short = model.with_values({"acquisition.n_frames": min(frames, 120)})
        movie = np.concatenate([block.movie for _, block in SimulatedAcquisition(short, seed=1).blocks()])
        blocks = (movie[: min(120, frames - at)] for at in range(0, frames, 120))
        files.write_movie(path, blocks, (frames, *shape), np.uint16, model=model, seed=1)
    return made


def test_interface_never_stands_still(make_napari_viewer, movies, tmp_path_factory):
    for name in ("XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME"):
        os.environ[name] = str(tmp_path_factory.mktemp(name))
    viewer = make_napari_viewer(show=True)
    viewer.window.resize(1500, 950)
    _, workflow = viewer.window.add_plugin_dock_widget("napari-mufasa", "MUFASA workflow")
    heart = Heart()
    print(f"\n{'ms':>6} {'of own work':>12} {'collection':>10} {'took s':>8}  worst gap of the interface")
    slow_cancels: list[str] = []
    try:
        for prefix in PARTS:
            if prefix != "first" and "idle" not in heart.worst:
                with heart.during("idle"):
                    rest(3)
                napari_alone(viewer, heart)
            story(
                viewer, workflow, movies["large" if prefix == "large" else "small"], heart, f"{prefix}: ", slow_cancels
            )
            viewer.layers.clear()
    finally:
        heart.stop()
    for what, (gap, _) in heart.worst.items():
        if gap > 0.1 and not what.startswith("first"):
            for stack, n in heart.late.get(what, Counter()).most_common(6):
                print(f"{what}: {n} × {stack}")
    own = {what: gap - heart.collecting.get(what, 0.0) for what, (gap, _) in heart.worst.items()}
    wrong = {what: gap for what, gap in own.items() if gap > allowed(what)}
    assert not wrong, f"the interface stood still longer than {BOUND_S} s: {wrong}"
    assert not slow_cancels


def allowed(what) -> float:
    return float("inf") if what.startswith(("first: ", "napari alone: ")) else BOUND_S


def napari_alone(viewer, heart) -> None:
    """What napari itself needs for a layer in an empty viewer and for points, with nothing of ours at work.

    The image has frames like the large movie's: software rendering compiles its shaders for that size once.
    """
    image = np.random.default_rng(0).integers(0, 99, (3, *SHAPE[1:]), dtype=np.uint16)
    for _ in range(2):
        with heart.during("napari alone: add an image"):
            viewer.add_image(image, contrast_limits=(0, 99))
            rest(0.5)
        with heart.during("napari alone: add points"):
            viewer.add_points(np.random.default_rng(0).random((40, 2)) * 128, face_color="transparent")
            rest(0.5)
        with heart.during("napari alone: remove layers"):
            viewer.layers.clear()


def story(viewer, workflow, path, heart, prefix, slow_cancels) -> None:
    from napari_mufasa.widgets.turns.live import live_of

    def press(panel, name, longest=LONGEST_S) -> bool:
        """Press Run; cancel what takes too long, and see that the panel is free at once."""
        longest = longest if prefix.startswith("large") else max(longest, 60)
        with heart.during(prefix + name):
            panel.run_bar.run_button.click()
            if wait_for(lambda: not panel.run_bar.running, longest):
                rest(0.6)
                return True
            start = time.perf_counter()
            panel.run_bar.cancel_button.click()
            wait_for(lambda: not panel.run_bar.running, 20)
            if time.perf_counter() - start > 1:
                slow_cancels.append(f"{prefix}{name}: {time.perf_counter() - start:.1f} s")
        start = time.perf_counter()  # the work itself may still be leaving
        wait_for(lambda: not any(t.name == "mufasa-work" for t in threading.enumerate()), 30)
        print(f"{'cancelled':>28}, the work left after {time.perf_counter() - start:.1f} s", flush=True)
        return False

    def show(number) -> None:
        workflow.tabs.setCurrentIndex(number)
        rest(0.3)

    data = workflow.step("Data")
    with heart.during(prefix + "open"):
        show(0)
        data.open_movie(str(path))
        wait_for(lambda: not data.run_bar.running)
        rest(0.6)
    with heart.during(prefix + "scrub"):
        n = len(viewer.layers[0].data)
        for frame in [*range(40), *np.random.default_rng(1).integers(0, n, 40)]:
            viewer.dims.set_point(0, int(frame))
            rest(0.03)
    with heart.during(prefix + "all steps shown"):
        for number in range(7):
            show(number)
    show(2)
    press(workflow.step("Denoise"), "denoise")
    workflow.step("Denoise").form.method.value = "source"
    if viewer.layers[0].data.shape[0] < 500:  # the result is a movie in memory
        press(workflow.step("Denoise"), "camera's inverse")
    workflow.step("Denoise").form.method.value = "pure-let-movie"
    show(3)
    molecules = workflow.step("Molecules")
    if press(molecules, "extract traces", 4 * LONGEST_S):
        with heart.during(prefix + "click molecules"):
            for index in range(6):
                molecules.points.selected_data = {index}
                rest(0.4)
    show(4)
    with heart.during(prefix + "edit the model"):
        power = workflow.step("Model").parts["excitation"].form["power_density_w_per_cm2"].native
        for watts in ("31", "33", "30"):
            power.setText(watts)
            power.editingFinished.emit()
            rest(0.3)
        wait_for(lambda: not live_of(workflow.session).busy, 30)
    show(5)
    compare = workflow.step("Compare")
    if press(compare, "compare"):
        with heart.during(prefix + "look at the comparison"):
            for tab in range(compare.tabs.count()):
                compare.tabs.setCurrentIndex(tab)
                rest(0.6)
    show(6)
    panel = workflow.step("Discover")
    panel.suspects.none_button.click()
    for row in range(panel.suspects.list.count()):
        item = panel.suspects.list.item(row)
        if item.data(Qt.ItemDataRole.UserRole) == "stage_drift":
            item.setCheckState(Qt.CheckState.Checked)
    if prefix.startswith("first") and "small" not in PARTS:  # nothing of it is looked at
        return
    if press(panel, "discover", LONGEST_S if prefix.startswith("large") else 200):
        with heart.during(prefix + "look at the report"):
            for row in range(min(4, panel.where.failing.rowCount())):
                panel.where.failing.selectRow(row)
                rest(0.5)
            for tab in range(panel.tabs.count()):
                panel.tabs.setCurrentIndex(tab)
                rest(0.5)
