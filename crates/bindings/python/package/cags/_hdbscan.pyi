from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, ClusterMixin

class HDBSCAN(ClusterMixin, BaseEstimator):
    labels_: NDArray[np.int64]
    probabilities_: NDArray[np.float64]
    outlier_scores_: NDArray[np.float64]
    n_features_in_: int
    @property
    def condensed_tree_(self) -> NDArray[np.void]: ...
    def __init__(
        self,
        min_cluster_size: int = 5,
        min_samples: int | None = None,
        cluster_selection_epsilon: float = 0.0,
        metric: str = "euclidean",
        n_jobs: int | None = None,
        cluster_selection_method: str = "eom",
        allow_single_cluster: bool = False,
    ) -> None: ...
    def fit(self, X: Any, y: Any = None) -> HDBSCAN: ...
    def approximate_predict(self, X: Any) -> tuple[NDArray[np.int64], NDArray[np.float64]]: ...
