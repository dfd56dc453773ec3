"""When other robots ask, as recorded by others in `benchmarks/demand`."""

from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent / "demand"
USUAL = "azure-code"


def arrivals(name: str, per_s: float, seconds: float, seed: int) -> list[float]:
    """When the others ask, in seconds: as many successive gaps of a recording, from a drawn place, scaled."""
    times = np.loadtxt(FOLDER / f"{name}.csv", skiprows=1)
    count = int(per_s * seconds)
    first = int(np.random.default_rng(seed).integers(len(times) - count))
    part = times[first : first + count + 1] - times[first]
    return [float(one) for one in part[:-1] * (seconds / part[-1])]
