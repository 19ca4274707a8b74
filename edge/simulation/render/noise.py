"""The tileable noise that all procedural texture is made of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

NOISE_SIZE = 512
_NOISE_SEED = 20_240
_CELLS = 22  # a side, of the cracked pattern


def noise_tile(size: int = NOISE_SIZE) -> NDArray[np.uint8]:
    """A tileable (size, size, 4) uint8 picture, each channel near uniform over [0, 255].

    Channels: 0 smooth cloudy noise (1/f), 1 another one of its kind, 2 grain (nearly white),
    3 distance to the nearest edge of irregular cells (0 on an edge; cracks, stones, leaves).
    """
    rng = np.random.default_rng(_NOISE_SEED)
    channels = [
        _flattened(_spectral(rng, size=size, falloff=1.25)),
        _flattened(_spectral(rng, size=size, falloff=1.25)),
        _flattened(_spectral(rng, size=size, falloff=0.35)),
        _flattened(_cell_edges(rng, size=size)),
    ]
    return np.ascontiguousarray(np.stack(channels, axis=-1))


def _spectral(rng: np.random.Generator, *, size: int, falloff: float) -> NDArray[np.float64]:
    """White noise shaped to amplitude 1 / frequency ** falloff; periodic by construction."""
    frequency = np.hypot(np.fft.fftfreq(size)[:, None], np.fft.rfftfreq(size)[None, :]) * size
    frequency[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((size, size))) / np.maximum(frequency, 2.0) ** falloff
    spectrum[0, 0] = 0.0
    return np.fft.irfft2(spectrum, s=(size, size))


def _cell_edges(rng: np.random.Generator, *, size: int) -> NDArray[np.float64]:
    """Second nearest minus nearest distance to jittered grid points, periodic."""
    jitter = rng.uniform(0.08, 0.92, (_CELLS, _CELLS, 2))
    bend = [_spectral(rng, size=size, falloff=1.6) for _ in range(2)]
    rows, columns = (np.mgrid[0:size, 0:size] / size * _CELLS).astype(float)
    rows += bend[0] / bend[0].std() * 0.10
    columns += bend[1] / bend[1].std() * 0.10
    row0, column0 = np.floor(rows).astype(int), np.floor(columns).astype(int)
    distances = np.empty((9, size, size))
    for index, (dr, dc) in enumerate((r, c) for r in (-1, 0, 1) for c in (-1, 0, 1)):
        point = jitter[(row0 + dr) % _CELLS, (column0 + dc) % _CELLS]
        distances[index] = np.hypot(row0 + dr + point[..., 0] - rows, column0 + dc + point[..., 1] - columns)
    nearest = np.partition(distances, 1, axis=0)
    return nearest[1] - nearest[0]


def _flattened(values: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Map to uint8 with all levels equally frequent: thresholds in shaders are then shares of area."""
    ranks = np.empty(values.size, np.int64)
    ranks[np.argsort(values, axis=None, kind="stable")] = np.arange(values.size)
    return (ranks * 256 // values.size).astype(np.uint8).reshape(values.shape)
