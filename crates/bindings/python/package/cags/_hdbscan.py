"""HDBSCAN as scikit-learn's estimators are."""

from numbers import Integral, Real

import numpy as np

try:
    from sklearn.base import BaseEstimator, ClusterMixin
    from sklearn.utils._param_validation import Interval, StrOptions
    from sklearn.utils.validation import check_is_fitted, validate_data
except ImportError as e:
    raise ImportError("cags.HDBSCAN needs scikit-learn 1.6 or later: pip install scikit-learn") from e

from . import _native
from ._points import threads_of


class HDBSCAN(ClusterMixin, BaseEstimator):
    """Hierarchical clustering by density, exact, with noise.

    Clusters may have any shape and different densities, and their number is found. It is the algorithm of
    :class:`sklearn.cluster.HDBSCAN`, with a spanning tree that is always the exact one, and the first of equals in one order of
    points: the result depends neither on the number of threads nor on the order in which the points come.

    Parameters
    ----------
    min_cluster_size : int, default=5
        Fewest points of a cluster.
    min_samples : int, default=None
        Points within the core distance of a point, itself included. None means ``min_cluster_size``.
    cluster_selection_epsilon : float, default=0.0
        Clusters that part below this distance stay one.
    metric : {'euclidean', 'l2', 'cosine', 'precomputed'}, default='euclidean'
        'precomputed': ``X`` holds distances, either all of them (an array of shape (n, n)) or those of a neighbour graph (a
        sparse matrix, such as ``kneighbors_graph(..., mode='distance')``): what neither of two rows holds is infinitely far.
        Parts of a graph that nothing joins are clustered apart.
    n_jobs : int, default=None
        Threads; None and -1 mean one per core. The result does not depend on it.
    cluster_selection_method : {'eom', 'leaf'}, default='eom'
        The clusters of largest excess of mass, or the finest.
    allow_single_cluster : bool, default=False
        Whether all points may be one cluster.

    Attributes
    ----------
    labels_ : int64 array of shape (n,)
        The cluster of every point, -1 for noise.
    probabilities_ : float64 array of shape (n,)
        How firmly a point belongs to its cluster, 0 to 1.
    outlier_scores_ : float64 array of shape (n,)
        How far a point is an outlier, 0 to 1 (GLOSH).
    condensed_tree_ : structured array
        The hierarchy, a row for everything that leaves a cluster: ``parent``, ``child``, ``lambda_val`` (1 / distance) and
        ``child_size``. Below n, ``child`` is a point; clusters are numbered from n, the root.
    n_features_in_ : int
        Columns of ``X``.

    Notes
    -----
    Distances are those of coordinates in float32. Those in float64 are moved to the middle of the set before they are rounded,
    to 1 / 16,000,000 of its extent.

    References
    ----------
    Campello, Moulavi and Sander 2013; McInnes and Healy 2017.

    Examples
    --------
    >>> import numpy as np
    >>> from cags import HDBSCAN
    >>> X = np.array([[0, 0], [0, 1], [1, 0], [8, 8], [8, 9], [9, 8], [40, 2]])
    >>> HDBSCAN(min_cluster_size=3, min_samples=2).fit_predict(X)
    array([ 0,  0,  0,  1,  1,  1, -1])
    """

    _parameter_constraints = {
        "min_cluster_size": [Interval(Integral, left=2, right=None, closed="left")],
        "min_samples": [Interval(Integral, left=1, right=None, closed="left"), None],
        "cluster_selection_epsilon": [Interval(Real, left=0, right=None, closed="left")],
        "metric": [StrOptions({"euclidean", "l2", "cosine", "precomputed"})],
        "n_jobs": [Integral, None],
        "cluster_selection_method": [StrOptions({"eom", "leaf"})],
        "allow_single_cluster": ["boolean"],
    }

    def __init__(
        self,
        min_cluster_size=5,
        min_samples=None,
        cluster_selection_epsilon=0.0,
        metric="euclidean",
        n_jobs=None,
        cluster_selection_method="eom",
        allow_single_cluster=False,
    ):
        self.min_cluster_size = min_cluster_size
        self.min_samples = min_samples
        self.cluster_selection_epsilon = cluster_selection_epsilon
        self.metric = metric
        self.n_jobs = n_jobs
        self.cluster_selection_method = cluster_selection_method
        self.allow_single_cluster = allow_single_cluster

    def fit(self, X, y=None):
        """Cluster points.

        Parameters
        ----------
        X : array of shape (n, features), or distances of shape (n, n)
            Points, or what ``metric='precomputed'`` means.
        y : ignored

        Returns
        -------
        self
        """
        self._validate_params()
        threads = threads_of(self.n_jobs)
        if self.metric == "precomputed":
            found = self._fit_distances(X, threads)
        else:
            found = self._fit_points(X, threads)
        self._tree, self._distinct = found["tree"], found["distinct"]
        self._tree["lambda_val"] = np.ldexp(self._tree["lambda_val"], -self._place[1])
        self.labels_ = found["labels"].astype(np.int64)
        self.probabilities_ = found["probabilities"].astype(np.float64)
        self.outlier_scores_ = found["outlier_scores"].astype(np.float64)
        return self

    def approximate_predict(self, X):
        """Say where points would fall that took no part, by the rules of ``hdbscan.approximate_predict``.

        The clusters stay as they are. A point at the place of one of the set need not get its label.

        Parameters
        ----------
        X : array of shape (m, features)

        Returns
        -------
        labels : int64 array of shape (m,)
        probabilities : float64 array of shape (m,)
        """
        check_is_fitted(self)
        if self.metric == "precomputed":
            raise ValueError("metric is 'precomputed': distances do not say where new points are")
        X = validate_data(self, X, dtype=[np.float64, np.float32], reset=False, ensure_min_samples=0)
        self._refuse_zeros(X)
        tree = dict(self._tree, lambda_val=np.ldexp(self._tree["lambda_val"], self._place[1]))
        parameters = self._native_parameters(len(self._points), threads_of(self.n_jobs))
        labels, probabilities = _native.hdbscan_predict(self._points, tree, self._placed(X), parameters)
        return labels.astype(np.int64), probabilities.astype(np.float64)

    @property
    def condensed_tree_(self):
        check_is_fitted(self)
        tree, distinct = self._tree, self._distinct
        n, m = len(distinct), tree["points"]
        rows = np.empty(len(tree["parent"]), [("parent", "i8"), ("child", "i8"), ("lambda_val", "f8"), ("child_size", "i8")])
        for name in rows.dtype.names:
            rows[name] = tree[name]
        rows["parent"] += n - m
        clusters, leaves = rows[rows["child"] >= m], rows[rows["child"] < m]
        clusters["child"] += n - m
        # A row for each of the points that are one distinct point.
        by_leaf = np.empty(m, np.int64)
        by_leaf[leaves["child"]] = np.arange(len(leaves))
        leaves = leaves[by_leaf[distinct]] if m else leaves
        leaves["child"], leaves["child_size"] = np.arange(n), 1
        return np.sort(np.concatenate([leaves, clusters]), order=["parent", "child"], kind="stable")

    def _fit_points(self, X, threads):
        X = validate_data(self, X, dtype=[np.float64, np.float32], ensure_min_samples=2)
        self._refuse_zeros(X)
        self._place = (0.0, 0)
        if X.dtype == np.float64 and self.metric != "cosine":
            low, high = X.min(axis=0), X.max(axis=0)
            # A power of two, so that no digit is lost: the set fits into -1 to 1.
            self._place = (0.5 * low + 0.5 * high, int(np.frexp(np.max(0.5 * high - 0.5 * low))[1]))
        self._points = self._placed(X)
        return _native.hdbscan(self._points, self._native_parameters(len(X), threads))

    def _fit_distances(self, X, threads):
        X = validate_data(self, X, accept_sparse="csr", dtype=np.float64, ensure_all_finite=False, ensure_min_samples=2)
        n, sparse = X.shape[0], not isinstance(X, np.ndarray)
        if X.shape != (n, n):
            raise ValueError(f"The precomputed distance matrix has shape {X.shape}: expected as many columns as rows")
        values = X.data if sparse else X
        if np.isnan(values).any() or (values < 0).any():
            raise ValueError("The precomputed distance matrix holds NaN or negative values: expected distances from 0 on")
        if not sparse and not np.allclose(X, X.T):
            raise ValueError("The precomputed distance matrix holds other values for (a, b) than for (b, a)")
        self._place = (0.0, 0)
        parameters = self._native_parameters(n, threads)
        if sparse:
            core = _core_distances(X, parameters["min_samples"])
            a, b, weight = np.repeat(np.arange(n), np.diff(X.indptr)), X.indices, X.data
        else:
            nth = parameters["min_samples"] - 1
            core = np.partition(X, nth, axis=1)[:, nth]
            a, b = np.triu_indices(n, 1)
            weight = X[a, b]
        weight = np.maximum(np.maximum(core[a], core[b]), weight)
        keep = (a != b) & np.isfinite(weight)
        a, b = (i[keep].astype(np.uint32) for i in (a, b))
        return _native.hdbscan_graph(n, a, b, weight[keep], parameters)

    def _refuse_zeros(self, X):
        zero = ~np.any(X != 0, axis=1)
        if self.metric == "cosine" and zero.any():
            raise ValueError(f"row {np.argmax(zero)} of X is 0: it has no direction, and no cosine distance to others")

    def _placed(self, X):
        middle, power = self._place
        if self.metric == "cosine":
            # Only the direction counts.
            X = np.ldexp(X, -np.frexp(np.abs(X).max(axis=1, keepdims=True))[1])
        elif X.dtype == np.float64:
            # What lies far outside of the set has no place in float32.
            X = np.clip(np.ldexp(X - middle, -power), -1e18, 1e18)
        return np.ascontiguousarray(X, dtype=np.float32)

    def _native_parameters(self, n, threads):
        min_samples = self.min_cluster_size if self.min_samples is None else self.min_samples
        if min_samples > n:
            raise ValueError(f"min_samples ({min_samples}) must be at most the number of samples in X ({n})")
        return {
            "min_cluster_size": int(self.min_cluster_size),
            "min_samples": int(min_samples),
            "epsilon": float(np.ldexp(self.cluster_selection_epsilon, -self._place[1])),
            "leaf": self.cluster_selection_method == "leaf",
            "allow_single_cluster": bool(self.allow_single_cluster),
            "cosine": self.metric == "cosine",
            "threads": threads,
        }

    def __sklearn_tags__(self):
        tags = super().__sklearn_tags__()
        tags.input_tags.sparse = self.metric == "precomputed"
        tags.input_tags.pairwise = self.metric == "precomputed"
        return tags


def _core_distances(graph, min_samples):
    """Core distances of a sparse graph, infinite where a row has too few; a point is its own first neighbour, held or not."""
    n = graph.shape[0]
    if min_samples == 1:
        return np.zeros(n)
    row = np.repeat(np.arange(n), np.diff(graph.indptr))
    others = row != graph.indices
    row, data = row[others], graph.data[others]
    data = data[np.lexsort((data, row))]
    count = np.bincount(row, minlength=n)
    nth = np.cumsum(count) - count + min_samples - 2
    enough = count >= min_samples - 1
    core = np.full(n, np.inf)
    core[enough] = data[nth[enough]]
    return core
