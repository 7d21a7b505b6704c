from os import PathLike
from typing import Any, Iterator, Literal, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ._hdbscan import HDBSCAN as HDBSCAN

def farthest_point_sample(
    points: ArrayLike, count: int, *, start: int = 0, n_jobs: int | None = None
) -> tuple[NDArray[np.int64], NDArray[np.int64]]: ...
def nearest_neighbours(points: ArrayLike, k: int, *, n_jobs: int | None = None) -> NDArray[np.int64]: ...

class Gaussians:
    means: NDArray[np.float32]
    log_scales: NDArray[np.float32]
    rotations: NDArray[np.float32]
    opacity_logits: NDArray[np.float32]
    sh: NDArray[np.float32]
    antialias: bool
    def __init__(
        self,
        means: ArrayLike,
        log_scales: ArrayLike,
        rotations: ArrayLike,
        opacity_logits: ArrayLike,
        sh: ArrayLike,
        antialias: bool = False,
    ) -> None: ...
    def __len__(self) -> int: ...
    def __getitem__(self, which: Any) -> Gaussians: ...

class Camera:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    rotation: NDArray[np.float64]
    translation: NDArray[np.float64]
    def __init__(
        self,
        width: int,
        height: int,
        fx: float,
        fy: float,
        cx: float,
        cy: float,
        rotation: ArrayLike = ...,
        translation: ArrayLike = ...,
    ) -> None: ...

class Rendered:
    rgb: NDArray[np.float32]
    alpha: NDArray[np.float32]
    depth: NDArray[np.float32]

def render(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: Sequence[float] = (0, 0, 0),
    near: float | None = None,
    n_jobs: int | None = None,
) -> Rendered: ...
def render_backward(
    gaussians: Gaussians,
    camera: Camera,
    d_rgb: ArrayLike,
    d_alpha: ArrayLike | None = None,
    d_depth: ArrayLike | None = None,
    *,
    background: Sequence[float] = (0, 0, 0),
    near: float | None = None,
    n_jobs: int | None = None,
) -> Gaussians: ...
def read_ply(path: str | PathLike[str]) -> Gaussians: ...
def write_ply(path: str | PathLike[str], gaussians: Gaussians, *, instance: ArrayLike | None = None) -> None: ...

class Artifact(Mapping[str, NDArray[Any]]):
    provenance: dict[str, Any]
    def __getitem__(self, name: str) -> NDArray[Any]: ...
    def __iter__(self) -> Iterator[str]: ...
    def __len__(self) -> int: ...

class Match:
    instance: int
    score: float

class Answer(list[Match]):
    matches: bool | None
    best: float | None
    by_chance: float | None

class Object:
    id: int
    name: str | None
    sure: bool
    note: str | None
    score: float
    gaussians: int
    siblings: list[int]
    centroid: NDArray[np.float64]
    center: NDArray[np.float64]
    half_size: NDArray[np.float64]
    axes: NDArray[np.float64]
    volume: float
    view: str | None

class Proposal:
    fit: float
    views: int
    gaussians: NDArray[np.uint32]

class Page:
    html: str
    height: int

class Run:
    labels: NDArray[np.int32]
    def __init__(self, folder: str | PathLike[str]) -> None: ...
    @property
    def gaussians(self) -> Gaussians: ...
    def artifact(self, format: Literal["graph", "footprints", "features", "instances"]) -> Artifact: ...
    def query(
        self, text: str, *, clip: str | PathLike[str] | None = None, text_features: str | PathLike[str] | None = None
    ) -> Answer: ...
    def select(self, instance: int) -> Gaussians: ...
    def objects(self) -> list[Object]: ...
    def proposals(self, overlap: float = 0.3) -> list[Proposal]: ...
    def to_dataframe(self) -> Any: ...
    def show(self, page: str | PathLike[str] | None = None, height: int = 600) -> Page: ...
    def to_open3d(self) -> Any: ...
