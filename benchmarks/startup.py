"""How much longer napari takes to start with this plugin installed than without it.

    xvfb-run -a python -m benchmarks.startup [repetitions]

Starts napari in fresh processes, in turn with and without the plugin's entry point, and prints the medians and their
difference. Bound: 0.3 s.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile

BOUND_S = 0.3
START = """
import importlib.metadata as metadata, sys, time, resource
if sys.argv[1] == "without":
    every = metadata.distributions
    metadata.distributions = lambda **k: [d for d in every(**k) if d.metadata["Name"] != "napari-mufasa"]
start = time.perf_counter()
import napari
from qtpy.QtWidgets import QApplication
viewer = napari.Viewer()
QApplication.processEvents()
took = time.perf_counter() - start
import npe2
known = {m.name for m in npe2.PluginManager.instance().iter_manifests()}
assert ("napari-mufasa" in known) == (sys.argv[1] == "with"), known
assert "napari_mufasa.widgets" not in sys.modules
used = resource.getrusage(resource.RUSAGE_SELF)
print("TOOK", took, used.ru_utime + used.ru_stime)
viewer.close()
"""


def start(how: str) -> tuple[float, float]:
    """Seconds by the clock and of CPU until the window is there."""
    with tempfile.TemporaryDirectory() as home:
        nobody = {name: home for name in ("XDG_CONFIG_HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME")}
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", START, how], env=os.environ | nobody, capture_output=True, text=True
        )
    line = next((line for line in done.stdout.splitlines() if line.startswith("TOOK")), None)
    if line is None:
        raise SystemExit(done.stderr)
    clock, cpu = (float(word) for word in line.split()[1:])
    return clock, cpu


def main() -> int:
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 7
    start("with"), start("without")  # files into the system's cache
    took: dict[str, list[tuple[float, float]]] = {"with": [], "without": []}
    for turn in range(repetitions):
        for how in ("with", "without") if turn % 2 else ("without", "with"):
            took[how].append(start(how))
    clock = {how: statistics.median(t for t, _ in times) for how, times in took.items()}
    cpu = {how: statistics.median(t for _, t in times) for how, times in took.items()}
    for name, median in (("clock", clock), ("CPU", cpu)):
        more = median["with"] - median["without"]
        print(f"{name}: with {median['with']:.2f} s, without {median['without']:.2f} s, difference {more:+.3f} s")
    return 0 if cpu["with"] - cpu["without"] <= BOUND_S else 1


if __name__ == "__main__":
    raise SystemExit(main())
