from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._hdbscan import HDBSCAN as HDBSCAN

def farthest_point_sample(
    points: ArrayLike, count: int, *, start: int = 0, n_jobs: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]: ...
def nearest_neighbours(points: ArrayLike, k: int, *, n_jobs: int | None = None) -> NDArray[np.int64]: ...
