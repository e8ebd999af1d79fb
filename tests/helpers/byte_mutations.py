"""Mutations of the bytes of any file."""

from __future__ import annotations

from typing import Any

import numpy as np


def truncated(rng: np.random.Generator, raw: bytearray) -> bytearray:
    return raw[: int(rng.integers(0, len(raw) + 1))]


def flipped(rng: np.random.Generator, raw: bytearray) -> bytearray:
    for at in rng.integers(0, len(raw), int(rng.integers(1, 20))):
        raw[at] ^= 1 << int(rng.integers(0, 8))
    return raw


def noise(rng: np.random.Generator, raw: bytearray) -> bytearray:
    start = int(rng.integers(0, len(raw)))
    raw[start : start + int(rng.integers(1, 200))] = rng.bytes(int(rng.integers(0, 300)))
    return raw


def zeroed(rng: np.random.Generator, raw: bytearray) -> bytearray:
    start, length = int(rng.integers(0, len(raw))), int(rng.integers(1, 500))
    raw[start : start + length] = bytes(len(raw[start : start + length]))
    return raw


def swapped(rng: np.random.Generator, raw: bytearray) -> bytearray:
    """Exchange two pieces of the same length."""
    length = int(rng.integers(1, max(2, len(raw) // 4)))
    a, b = (int(k) for k in rng.integers(0, max(1, len(raw) - length), 2))
    raw[a : a + length], raw[b : b + length] = raw[b : b + length], raw[a : a + length]
    return raw


OF_BYTES = (truncated, flipped, noise, zeroed, swapped)


def pick(rng: np.random.Generator, among: tuple[Any, ...]) -> Any:
    return among[int(rng.integers(0, len(among)))]


def some(rng: np.random.Generator, raw: bytearray, among: tuple[Any, ...]) -> bytearray:
    for _ in range(int(rng.integers(0, 3))):
        if raw:
            raw = pick(rng, among)(rng, raw)
    return raw
