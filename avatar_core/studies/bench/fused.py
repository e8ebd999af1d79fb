"""The bare scene's step against a linear step that was fused by hand into one function.

Where a process happens to place code and arrays moves the ratio by 2 or 3 % either way, the same
for all of its life: it is measured in processes of their own, and their median counts.
"""

from __future__ import annotations

import importlib.util
import multiprocessing
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from avatar_core.contact.model import ContactModel, compiled_for, prepare, step
from avatar_core.studies.bench.methods import PATCH
from avatar_core.vademecum.model import Vademecum
from avatar_core.vademecum.storage import load_vademecum, save_vademecum

N_PROCESSES = 7
_WARM = 200  # steps until the caches are


def fused_ratios(vademecum: Vademecum, path: np.ndarray, fused: Path) -> list[float]:
    """Time of the bare step over that of the one fused by hand, of each process.

    Parameters
    ----------
    vademecum : linear
    path : ndarray, shape (n_steps, 1, 3), positions of the tip [m]
    fused : file with ``fused_step``, jitted
    """
    spawn = multiprocessing.get_context("spawn")
    ratios = []
    with tempfile.TemporaryDirectory() as folder:
        stored = Path(folder) / "linear.h5"
        save_vademecum(vademecum, stored)
        for _ in range(N_PROCESSES):
            with ProcessPoolExecutor(1, mp_context=spawn) as process:
                ratios.append(process.submit(_of_process, stored, path, fused).result())
    return ratios


def _of_process(stored: Path, path: np.ndarray, fused: Path) -> float:
    bare = prepare(load_vademecum(stored), (PATCH,), cloud="volume", effects=())
    return fused_ratio(bare, module_of(fused).fused_step, path)


def module_of(path: Path) -> ModuleType:
    """A Python file outside of any package, under its own name, where numba's cache finds it."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)
    return module


def fused_ratio(bare: ContactModel, fused: Callable[..., int], path: np.ndarray) -> float:
    """Median over pairs of slides of bare over fused; both work on the same arrays.

    Raises
    ------
    AssertionError
        If the two disagree by more than 1e-12 of the force, or in the cloud.
    """
    *tables, effects = bare.tables
    arguments = (*tables, bare.tips)
    bare.tips[:] = path[0]
    overload = compiled_for(fused, *arguments)
    compiled = bare.compiled.step
    assert compiled is not None
    _agree(bare, lambda: overload(*arguments), path[::50])
    calls = (lambda: overload(*arguments), lambda: compiled(*arguments, effects))
    ratios = []
    for first in range(_WARM, len(path) - 100, 100):
        for _ in range(3):
            taken, part = [0.0, 0.0], path[first : first + 100]
            for which in (0, 1, 1, 0):  # neither is always the one that finds warm caches
                taken[which] += _median_time(calls[which], bare.tips, part)
            ratios.append(taken[1] / taken[0])
    return float(np.median(ratios))


def _median_time(call: Callable[[], int], tips: np.ndarray, path: np.ndarray) -> float:
    times = np.empty(len(path))
    for k, tip in enumerate(path):
        tips[:] = tip
        start = time.perf_counter_ns()
        call()
        times[k] = time.perf_counter_ns() - start
    return float(np.median(times))


def _agree(bare: ContactModel, fused: Callable[[], int], path: Sequence[Any] | np.ndarray) -> None:
    for tips in path:
        step(bare, tips)
        force, cloud = bare.out.force.copy(), bare.out.cloud.copy()
        bare.tips[:] = tips
        fused()
        scale = max(float(np.abs(force).max()), 1e-9)
        assert np.abs(bare.out.force - force).max() <= 1e-12 * scale, "forces differ"
        assert np.abs(bare.out.cloud - cloud).max() <= 1e-12, "clouds differ"
