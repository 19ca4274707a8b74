"""The light of a random day."""

from __future__ import annotations

import numpy as np

from edge.simulation.scene import Light


def draw_light(rng: np.random.Generator) -> Light:
    """Sun, sky and air of a random day."""
    azimuth = float(rng.uniform(0.0, 2.0 * np.pi))
    elevation = float(np.radians(rng.uniform(14.0, 62.0)))
    towards_sun = np.array(
        [np.cos(elevation) * np.sin(azimuth), -np.sin(elevation), np.cos(elevation) * np.cos(azimuth)]
    )
    weather = rng.choice(3, p=[0.6, 0.2, 0.2])
    cloud = float((rng.uniform(0.0, 0.3), rng.uniform(0.3, 0.65), rng.uniform(0.7, 1.0))[int(weather)])
    low = np.clip((np.degrees(elevation) - 10.0) / 35.0, 0.0, 1.0)
    strength = float(rng.uniform(2.4, 4.2))
    sun = (strength, strength * (0.80 + 0.14 * low), strength * (0.62 + 0.24 * low))
    sky = float(rng.uniform(0.75, 1.2))
    zenith = (0.22 * sky, 0.42 * sky, 0.80 * sky)
    grey = 0.75 * sky
    mix = cloud**1.5
    zenith = tuple(float((1 - mix) * value + mix * grey) for value in zenith)
    horizon = tuple(float(sky * value) for value in (0.78, 0.86, 0.95))
    haze = float(np.exp(rng.uniform(np.log(0.0003), np.log(0.005))))
    return Light(towards_sun, sun, zenith, horizon, cloud_cover=cloud, haze_per_m=haze)  # type: ignore[arg-type]
