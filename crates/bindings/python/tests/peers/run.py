"""The tests that scikit-learn and hdbscan have for their own HDBSCAN, run with cags.HDBSCAN in its place.

    python tests/peers/run.py

Needs scikit-learn, hdbscan and pytest, whose wheels hold these tests. Those that do not apply are listed below with the reason,
and printed; a name here that no test has is an error, so that the list stays true.
"""

import sys

import hdbscan
import numpy as np
import pytest
import sklearn.cluster

import cags

OTHER_METRICS = "metrics: euclidean, cosine and precomputed here"
MISSING = "NaN and infinite values are refused here, as most estimators of scikit-learn do"
INSIDES = "tests private functions of the library"
CENTERS = "centres are not computed"
FUNCTION = "tests the function hdbscan.hdbscan, which returns trees of that library"
PLOTS = "tests plots and exports of trees of that library"

SCIKIT_LEARN = {
    "test_outlier_data": MISSING,
    "test_dbscan_clustering": "no cuts of the tree at one distance",
    "test_dbscan_clustering_outlier_data": MISSING,
    "test_hdbscan_algorithms": OTHER_METRICS + ", and one algorithm",
    "test_hdbscan_best_balltree_metric": OTHER_METRICS,
    "test_hdbscan_callable_metric": OTHER_METRICS,
    "test_hdbscan_precomputed_non_brute": "one algorithm",
    "test_hdbscan_sparse": "sparse matrices of points are refused",
    "test_hdbscan_centers": CENTERS,
    "test_hdbscan_error_precomputed_and_store_centers": CENTERS,
    "test_hdbscan_sparse_distances_too_few_nonzero": "points with too few neighbours are noise here",
    "test_hdbscan_sparse_distances_disconnected_graph": "parts of a graph are clustered apart here",
    "test_hdbscan_tree_invalid_metric": OTHER_METRICS + ", and one algorithm",
    "test_hdbscan_precomputed_dense_nan": "refused in other words: tests/test_hdbscan.py",
    "test_labelling_distinct": INSIDES,
    "test_labelling_thresholding": INSIDES,
    "test_hdbscan_cosine_metric_invalid_algorithm": "one algorithm",
    "test_hdbscan_default_copy_warning": "input is never changed: there is no copy to ask for",
}

HDBSCAN = {
    "test_missing_data": MISSING,
    "test_hdbscan_dbscan_clustering": "no cuts of the tree at one distance",
    "test_hdbscan_best_balltree_metric": OTHER_METRICS,
    "test_hdbscan_high_dimensional": OTHER_METRICS,
    "test_hdbscan_callable_metric": OTHER_METRICS,
    "test_condensed_tree_plot": PLOTS,
    "test_single_linkage_tree_plot": PLOTS,
    "test_min_span_tree_plot": PLOTS,
    "test_tree_numpy_output_formats": PLOTS,
    "test_tree_pandas_output_formats": PLOTS,
    "test_tree_networkx_output_formats": PLOTS,
    "test_hdbscan_approximate_predict": "asks for the number that the library gave a cluster: tests/test_hdbscan.py",
    "test_hdbscan_approximate_predict_score": "no scores of predictions",
    "test_hdbscan_all_points_membership_vectors": "no vectors of membership",
    "test_hdbscan_badargs": FUNCTION,
    "test_hdbscan_sparse": "sparse matrices of points are refused",
    "test_hdbscan_caching": "keeps no files",
    "test_hdbscan_centroids_medoids": CENTERS,
    "test_hdbscan_no_centroid_medoid_for_noise": CENTERS,
    "test_hdbscan_allow_single_cluster_with_epsilon": "counts the noise of one of two trees that tie: reversed points give it 38, not 46",
    "test_hdbscan_persistence_threshold": "no threshold of persistence",
    "test_hdbscan_cluster_selection_epsilon_max": "no largest epsilon",
    "test_hdbscan_parameters_do_not_trigger_errors": "names all parameters of that library",
}


def scikit_learns(copy=True, algorithm="auto", **options):
    """With its parameters that choose how, not what."""
    return cags.HDBSCAN(**options)


class Hdbscans(cags.HDBSCAN):
    """With its defaults, and ``min_samples`` that does not count the point itself."""

    def __init__(self, min_cluster_size=5, min_samples=None, algorithm="best", gen_min_span_tree=False, prediction_data=False, **rest):
        super().__init__(min_cluster_size=min_cluster_size, min_samples=min_samples, **rest)
        self.algorithm, self.gen_min_span_tree, self.prediction_data = algorithm, gen_min_span_tree, prediction_data

    def fit(self, X, y=None):
        others = min(self.min_cluster_size if self.min_samples is None else self.min_samples, np.shape(X)[0] - 1)
        self.__dict__.update(cags.HDBSCAN(**{**self.ours(), "min_samples": others + 1}).fit(X).__dict__)
        return self

    def ours(self):
        return {name: getattr(self, name) for name in cags.HDBSCAN().get_params()}


class Applicable:
    """Leaves out what does not apply, and says so."""

    def __init__(self, reasons):
        self.reasons, self.failed = reasons, []

    def pytest_collection_modifyitems(self, config, items):
        out = [i for i in items if i.originalname in self.reasons]
        unknown = set(self.reasons) - {i.originalname for i in items}
        if unknown:
            raise pytest.UsageError(f"no such tests any more: {sorted(unknown)}")
        items[:] = [i for i in items if i not in out]
        config.hook.pytest_deselected(items=out)
        for name, why in self.reasons.items():
            print(f"does not apply: {name}: {why}")


def main():
    print(f"scikit-learn {sklearn.__version__}")
    sklearn.cluster.HDBSCAN = scikit_learns
    common = ["-q", "-p", "no:cacheprovider", "-c", "/dev/null", "--pyargs"]
    first = pytest.main([*common, "sklearn.cluster.tests.test_hdbscan"], plugins=[Applicable(SCIKIT_LEARN)])
    print("hdbscan")
    hdbscan.HDBSCAN = Hdbscans
    hdbscan.approximate_predict = lambda model, X: model.approximate_predict(X)
    second = pytest.main([*common, "hdbscan.tests.test_hdbscan"], plugins=[Applicable(HDBSCAN)])
    return int(first or second)


if __name__ == "__main__":
    sys.exit(main())
