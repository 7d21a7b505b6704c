"""From Gaussian splats to objects, and the parts of that which stand alone, on a plain CPU.

===========================  ======================================================================
``HDBSCAN``                  exact hierarchical clustering, an estimator of scikit-learn
``farthest_point_sample``    points spread evenly over a cloud
``nearest_neighbours``       the nearest other points of each point
===========================  ======================================================================

Results depend neither on the number of threads nor on the machine. Long work releases the interpreter lock.
"""

from ._points import farthest_point_sample, nearest_neighbours

__all__ = ["HDBSCAN", "farthest_point_sample", "nearest_neighbours"]


def __getattr__(name):
    # scikit-learn is slow to load, and not everybody has it.
    if name == "HDBSCAN":
        from ._hdbscan import HDBSCAN

        return HDBSCAN
    raise AttributeError(f"module 'cags' has no attribute {name!r}")


def __dir__():
    return sorted(__all__)
