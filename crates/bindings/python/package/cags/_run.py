"""Finished runs of the pipeline."""

import html
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from . import _native
from ._gaussians import read_ply

_ARTIFACTS = {"graph": 1, "footprints": 1, "features": 1, "instances": 1}


class Artifact(Mapping):
    """The tensors of an artifact by name: read-only arrays that lie in the file, not in memory.

    Attributes
    ----------
    provenance : dict
        Format, version, program, parameters, hashes of the inputs.
    """

    def __init__(self, path, format):
        self.provenance = json.loads(_native.check_artifact(path, format, _ARTIFACTS[format]))
        bytes_ = np.memmap(path, dtype=np.uint8, mode="r")
        size = int(bytes_[:8].view("<u8")[0])
        header = json.loads(bytes_[8 : 8 + size].tobytes())
        header.pop("__metadata__", None)
        kinds = {"F": "<f", "I": "<i", "U": "<u"}
        self._tensors = {}
        for name, tensor in header.items():
            start, end = (8 + size + at for at in tensor["data_offsets"])
            kind = kinds[tensor["dtype"][0]] + str(int(tensor["dtype"][1:]) // 8)
            self._tensors[name] = bytes_[start:end].view(kind).reshape(tensor["shape"])

    def __getitem__(self, name):
        return self._tensors[name]

    def __iter__(self):
        return iter(self._tensors)

    def __len__(self):
        return len(self._tensors)


@dataclass
class Match:
    """An instance that answers a text: its number, and the cosine of its descriptor with the text's feature."""

    instance: int
    score: float


class Answer(list):
    """The instances that answer a text, as a list of :class:`Match`, best first.

    Attributes
    ----------
    matches : bool or None
        Whether the text matches anything: its best score is better than that of 95 of 100 unrelated texts. None for a table of
        text features that holds no unrelated texts.
    best, by_chance : float or None
        Its best score over instances, parts and groups, and what those texts reach.
    """

    def __init__(self, ranking, verdict):
        super().__init__(Match(*match) for match in ranking)
        self.matches, self.best, self.by_chance = verdict or (None, None, None)


@dataclass
class Object:
    """A thing of the scene; lengths are in its units.

    Attributes
    ----------
    id : int
        Its instance.
    name : str or None
        As a person named it, else the best of a vocabulary where ``eval names`` was run.
    sure : bool
        False where the name is a guess, or there is none.
    note : str or None
        What a person noted of it.
    score : float
        Confidence that it is one whole thing, 0 to 1.
    gaussians : int
        How many it has.
    siblings : list of int
        Objects that are parts of the same whole, itself among them; empty where nothing connects it.
    centroid : array of shape (3,)
        Mean of the Gaussians' centres.
    center, half_size : array of shape (3,)
        Its box, upright where the photographs say what is up.
    axes : array of shape (3, 3)
        The box's unit axes, in rows.
    volume : float
        Of the box.
    view : str or None
        The photograph that shows most of it.
    """

    id: int
    name: str
    sure: bool
    note: str
    score: float
    gaussians: int
    siblings: list
    centroid: np.ndarray
    center: np.ndarray
    half_size: np.ndarray
    axes: np.ndarray
    volume: float
    view: str


@dataclass
class Proposal:
    """What masks show as one; proposals may overlap, the instances don't.

    Attributes
    ----------
    fit : float
        Mean IoU with the best mask of each view that shows it, 0 to 1.
    views : int
        How many views have a mask that shows it as one.
    gaussians : uint32 array
        Its Gaussians, ascending.
    """

    fit: float
    views: int
    gaussians: np.ndarray


class Page:
    """A page that a notebook shows where it stands as the value of a cell."""

    def __init__(self, html, height):
        self.html, self.height = html, height

    def _repr_html_(self):
        return f'<iframe srcdoc="{html.escape(self.html)}" width="100%" height="{self.height}" style="border:0"></iframe>'


class Run:
    """A finished run: the folder ``OUT`` of ``make scene`` or ``cags run``.

    Gaussians, photographs and the language model are those of the run, as its records name them.

    Parameters
    ----------
    folder : path

    Attributes
    ----------
    labels : int32 array of shape (n,)
        Instance of every Gaussian, -1 for none, with what a person merged and split in the browser.
    gaussians : Gaussians

    Examples
    --------
    >>> run = cags.Run("out/demo")                                              # doctest: +SKIP
    >>> found = run.query("green kettle")                                       # doctest: +SKIP
    >>> if found.matches:                                                       # doctest: +SKIP
    ...     cags.write_ply("kettle.ply", run.select(found[0].instance))
    """

    def __init__(self, folder):
        self.folder = Path(folder)
        found = {name: _native.input_of_run(self.folder, name) for name in ("instances", "geometry", "scene")}
        for name in ("instances", "geometry"):
            if found[name] is None:
                raise ValueError(f"{self.folder}: the run is not finished: there are no {name}")
        edits = self.folder / "instances.edits.json"
        self._scene = found["scene"]
        self._geometry = found["geometry"]
        self._labelled = _native.Labelled(found["instances"], found["geometry"], edits if edits.exists() else None)
        self._words = {}
        self._gaussians = None
        self.labels = self._labelled.labels()

    def __repr__(self):
        return f"Run({str(self.folder)!r}): {len(self.labels)} Gaussians, {len(set(self.labels.tolist()) - {-1})} instances"

    @property
    def gaussians(self):
        if self._gaussians is None:
            self._gaussians = read_ply(self._geometry)
        return self._gaussians

    def artifact(self, format):
        """The tensors of ``graph``, ``footprints``, ``features`` or ``instances``; docs/artifacts.md says what they mean.

        A person's edits are not in them.
        """
        if format not in _ARTIFACTS:
            raise ValueError(f"there is no artifact {format!r}: expected one of {', '.join(_ARTIFACTS)}")
        path = _native.input_of_run(self.folder, format)
        if path is None:
            raise ValueError(f"{self.folder}: the run has no {format}")
        return Artifact(path, format)

    def query(self, text, *, clip=None, text_features=None):
        """Rank the instances by how well they fit a text.

        Parameters
        ----------
        text : str
        clip : path, optional
            Folder of a CLIP model; by default the one that the run was scored or asked with. It must be the one that encoded the
            masks. It is loaded once.
        text_features : path, optional
            A table of text features, in its place.

        Returns
        -------
        Answer
            All instances with a descriptor, as a list of :class:`Match`, best first; ``matches`` says whether the best is better
            than by chance.
        """
        if clip is None and text_features is None:
            clip = _native.input_of_run(self.folder, "clip")
            text_features = _native.input_of_run(self.folder, "text-features") if clip is None else None
        if clip is None and text_features is None:
            raise ValueError(f"{self.folder}: the run names no language model: give clip or text_features")
        key = (str(clip), str(text_features))
        if key not in self._words:
            self._words[key] = _native.Words(self._labelled, clip, text_features)
        return Answer(*self._words[key].rank(self._labelled, text))

    def select(self, instance):
        """The Gaussians of an instance, as :class:`Gaussians`."""
        mask = self.labels == instance
        if not mask.any():
            raise ValueError(f"no Gaussian has the instance {instance}")
        return self.gaussians[mask]

    def objects(self):
        """All things of the scene, as a list of :class:`Object`, ascending by id."""
        names = self.folder / "names.json"
        scene = json.loads(self._labelled.objects(self._scene, names if names.exists() else None))
        return [
            Object(
                id=o["id"],
                name=o["name"] and o["name"]["text"],
                sure=bool(o["name"]) and o["name"].get("sure", True),
                note=o.get("note"),
                score=o["score"],
                gaussians=o["gaussians"],
                siblings=o["parent"]["objects"] if o["parent"] else [],
                centroid=np.array(o["centroid"]),
                center=np.array(o["box"]["center"]),
                half_size=np.array(o["box"]["half_size"]),
                axes=np.array(o["box"]["axes"]),
                volume=o["volume"],
                view=o["best_view"] and o["best_view"]["view"],
            )
            for o in scene["objects"]
        ]

    def proposals(self, overlap=0.3):
        """What masks show as one thing, as a list of :class:`Proposal`, best fit first.

        Instances divide the scene; proposals may lie within each other: the cup, its handle, the set of cups.

        Parameters
        ----------
        overlap : float
            One whose IoU with a better one is this or more is left out; above 1 all stay.
        """
        return [Proposal(*p) for p in self._labelled.proposals(overlap)]

    def to_dataframe(self):
        """The :meth:`objects` as ``pandas.DataFrame``, a row for each, by id. Needs pandas."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_dataframe needs pandas: pip install pandas") from None
        own = ["id", "name", "sure", "note", "score", "gaussians", "volume", "view"]
        rows = [[getattr(o, k) for k in own] + o.center.tolist() + (2 * o.half_size).tolist() for o in self.objects()]
        return pandas.DataFrame(rows, columns=[*own, "x", "y", "z", "size_1", "size_2", "size_3"]).set_index("id")

    def show(self, page=None, height=600):
        """The scene in a notebook, to turn and click, as the value of a cell.

        Parameters
        ----------
        page : path, optional
            The file that ``explore page --run-dir FOLDER --out FOLDER/page.html`` writes, by default that one. It becomes a part of
            the notebook.
        height : int
            In pixels.
        """
        page = self.folder / "page.html" if page is None else Path(page)
        if not page.exists():
            raise FileNotFoundError(f"{page}: no such page; explore page --run-dir {self.folder} --out {page} writes it")
        return Page(page.read_text(encoding="utf-8"), height)

    def to_open3d(self):
        """The Gaussians' centres as ``open3d.geometry.PointCloud``, in their own colours. Needs open3d."""
        try:
            import open3d
        except ImportError:
            raise ImportError("to_open3d needs open3d: pip install open3d") from None
        cloud = open3d.geometry.PointCloud()
        cloud.points = open3d.utility.Vector3dVector(self.gaussians.means.astype(np.float64))
        # The constant harmonic's factor.
        colours = np.clip(0.5 + 0.28209479177387814 * self.gaussians.sh[:, 0], 0, 1)
        cloud.colors = open3d.utility.Vector3dVector(colours.astype(np.float64))
        return cloud
