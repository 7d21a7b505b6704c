"""From Gaussian splats to objects, and the parts of that which stand alone, on a plain CPU.

===========================  ======================================================================
``HDBSCAN``                  exact hierarchical clustering, an estimator of scikit-learn
``farthest_point_sample``    points spread evenly over a cloud
``nearest_neighbours``       the nearest other points of each point
``Gaussians``, ``Camera``    a scene, and from where it is seen
``render``                   the picture of it
``render_backward``          the gradient of every parameter, given that of every pixel
``read_ply``, ``write_ply``  files of Gaussians, in all formats of docs/splats.md
``Run``                      a finished run: its artifacts, objects, and questions in words
===========================  ======================================================================

Results depend neither on the number of threads nor on the machine. Long work releases the interpreter lock.
"""

from ._gaussians import Camera, Gaussians, Rendered, read_ply, render, render_backward, write_ply
from ._points import farthest_point_sample, nearest_neighbours
from ._run import Answer, Artifact, Match, Object, Page, Proposal, Run

__all__ = [
    "HDBSCAN",
    "Answer",
    "Artifact",
    "Camera",
    "Gaussians",
    "Match",
    "Object",
    "Page",
    "Proposal",
    "Rendered",
    "Run",
    "farthest_point_sample",
    "nearest_neighbours",
    "read_ply",
    "render",
    "render_backward",
    "write_ply",
]


def __getattr__(name):
    # scikit-learn is slow to load, and not everybody has it.
    if name == "HDBSCAN":
        from ._hdbscan import HDBSCAN

        return HDBSCAN
    raise AttributeError(f"module 'cags' has no attribute {name!r}")


def __dir__():
    return sorted(__all__)
