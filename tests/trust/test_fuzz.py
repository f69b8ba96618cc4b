"""What the fuzzer made up, and seeds spoilt here: each is read or refused, and nothing else (`make fuzz` goes on)."""

from __future__ import annotations

import importlib.util
import random
import warnings
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

from napari_mufasa.errors import MufasaError

ROOT = Path(__file__).parents[2]
CORPUS = Path(__file__).parent / "corpus"
SPOILT = 150  # of each seed


def fuzzer() -> ModuleType:
    spec = importlib.util.spec_from_file_location("fuzz", ROOT / "tools" / "fuzz.py")
    assert spec is not None and spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


FUZZ = fuzzer()


def feed(target: str, data: bytes, folder: Path) -> bool:
    """Whether it was read; False when it was refused in words."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            FUZZ.TARGETS[target](data, folder)
        except MufasaError as told:
            assert str(told).strip()
            return False
    return True


def spoilt(data: bytes, chance: random.Random) -> bytes:
    """Bytes flipped, cut out, doubled, or cut off."""
    content = bytearray(data)
    for _ in range(chance.randint(1, 6)):
        at, n = chance.randrange(max(len(content), 1)), chance.randint(1, 16)
        kind = chance.randrange(4)
        if kind == 0:
            content[at : at + 1] = bytes([chance.randrange(256)])
        elif kind == 1:
            del content[at : at + n]
        elif kind == 2:
            content[at:at] = content[at : at + n]
        else:
            content[at : at + n] = chance.choice([b"\xff" * n, b"\0" * n, b"9" * n])
    return bytes(content[: chance.randrange(len(content) + 1)] if chance.random() < 0.1 else content)


@pytest.mark.parametrize("target", FUZZ.TARGETS)
def test_what_the_fuzzer_made_up(target, tmp_path):
    with zipfile.ZipFile(CORPUS / f"{target}.zip") as archive:
        inputs = [archive.read(name) for name in archive.namelist()]
    assert len(inputs) > 20
    read = [feed(target, data, tmp_path) for data in inputs]
    assert not all(read)  # some are refused


@pytest.mark.parametrize("target", FUZZ.TARGETS)
def test_spoilt_seeds(target, tmp_path):
    FUZZ.make_seeds(target, tmp_path / "seeds")
    chance = random.Random(7)
    made = {path.name: path.read_bytes() for path in sorted((tmp_path / "seeds").iterdir())}
    refused = {name for name, seed in made.items() if not feed(target, seed, tmp_path)}
    assert refused == ({"axes.tif"} if target == "tiff" else set())  # that one has channels
    seeds = list(made.values())
    per_seed = max(10, SPOILT // len(seeds))
    outcomes = [feed(target, spoilt(seed, chance), tmp_path) for seed in seeds for _ in range(per_seed)]
    assert not all(outcomes)
