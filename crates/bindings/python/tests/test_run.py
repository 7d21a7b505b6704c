"""cags.Run on a run that the programs made."""

import html
import json
import subprocess
import sys
import types
from pathlib import Path

import jsonschema
import numpy as np
import pytest

import cags

ROOT = Path(__file__).resolve().parents[4]
PROGRAM = ROOT / "target/release/cags"
CLIP = ROOT / "testdata/clip-tiny"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    if not PROGRAM.exists():
        pytest.skip(f"no {PROGRAM}: cargo build --release")
    work = tmp_path_factory.mktemp("run")
    subprocess.run([PROGRAM, "synth-scene", "--size", "tiny", "--out", "photos", "--quiet"], cwd=work, check=True)
    line = [PROGRAM, "run", "photos", "-o", "out", "ITERATIONS=200", "MASKS=photos/language_features", f"CLIP={CLIP}", "FEAT_ARGS=--dim 64", "--quiet"]
    subprocess.run(line, cwd=work, check=True)
    return work / "out"


@pytest.fixture(scope="module")
def run(folder):
    return cags.Run(folder)


def test_labels_and_gaussians_belong_together(run, folder):
    assert len(run.labels) == len(run.gaussians) and run.labels.dtype == np.int32
    np.testing.assert_array_equal(run.labels, np.load(folder / "instances.labels.npy"))
    chosen = run.select(0)
    assert len(chosen) == (run.labels == 0).sum() > 0
    np.testing.assert_array_equal(chosen.means, run.gaussians.means[run.labels == 0])
    with pytest.raises(ValueError, match="instance 12345"):
        run.select(12345)
    assert str(folder) in repr(run)


def test_artifacts_lie_in_the_file(run, folder):
    instances = run.artifact("instances")
    np.testing.assert_array_equal(instances["label"], run.labels)
    assert isinstance(instances["label"].base, np.memmap) or isinstance(instances["label"], np.memmap)
    with pytest.raises(ValueError):
        instances["label"][0] = 1
    graph = run.artifact("graph")
    assert graph["knn"].dtype == np.uint32 and graph["knn"].shape[0] == len(graph["anchors"])
    assert run.artifact("footprints")["row_ptr"].dtype == np.uint64
    assert run.artifact("features")["features"].shape[0] == len(graph["kept"])
    assert graph.provenance["format"] == "graph" and set(graph) >= {"kept", "knn"}
    with pytest.raises(ValueError, match="no artifact"):
        run.artifact("masks")


def test_questions_are_answered_as_eval_query_does(run, folder, tmp_path):
    line = [PROGRAM, "query", "--run-dir", folder, "--text", "red mug", "--granularity", "instance", "--out", tmp_path / "q", "--quiet"]
    subprocess.run(line, check=True)
    ranking = json.loads((tmp_path / "q/query.json").read_text())["queries"][0]["ranking"]
    for answer in (run.query("red mug"), run.query("red mug", clip=CLIP)):
        assert [(m.instance, pytest.approx(m.score, abs=1e-6)) for m in answer[: len(ranking)]] == [
            (r["instance"], r["score"]) for r in ranking
        ]
    with pytest.raises(ValueError, match="no such model"):
        run.query("red mug", clip=tmp_path)


def test_an_answer_says_whether_anything_matches(run, folder, tmp_path):
    texts = ["floor", "zeppelin"]
    line = [PROGRAM, "query", "--run-dir", folder, "--out", tmp_path / "q", "--quiet"]
    subprocess.run([*line, *(o for text in texts for o in ("--text", text))], check=True)
    for text, asked in zip(texts, json.loads((tmp_path / "q/query.json").read_text())["queries"]):
        found, verdict = run.query(text), asked["verdict"]
        assert (found.matches, bool(asked["selected"])) == (verdict["matches"], verdict["matches"]), text
        assert found.matches == (found.best > found.by_chance) and found.best >= found[0].score
        assert (found.best, found.by_chance) == pytest.approx((verdict["best"], verdict["by_chance"]), abs=1e-6)
    table = tmp_path / "texts.json"
    dim = run.artifact("instances")["descriptor"].shape[1]
    table.write_text(json.dumps({"mug": [1.0] + [0.0] * (dim - 1)}))
    assert run.query("mug", text_features=table).matches is None


def test_objects_are_those_of_the_labels(run):
    objects = run.objects()
    assert {o.id: o.gaussians for o in objects} == {int(k): int((run.labels == k).sum()) for k in set(run.labels.tolist()) - {-1}}
    o = objects[0]
    np.testing.assert_allclose(o.axes @ o.axes.T, np.eye(3), atol=1e-5)
    np.testing.assert_allclose(o.centroid, run.select(o.id).means.mean(axis=0), atol=1e-3)
    named = {n["instance"]: n for n in json.loads((run.folder / "names.json").read_text())["named"]}
    for o in objects:
        best = named.get(o.id)
        assert (o.name, o.sure) == ((best["names"][0]["name"], best["sure"]) if best else (None, False))
    o = objects[0]
    assert o.volume == pytest.approx(8 * np.prod(o.half_size), rel=1e-4)


def test_proposals_may_overlap_but_are_not_the_same_twice(run):
    everything, proposals = run.proposals(overlap=1.1), run.proposals()
    assert 0 < len(proposals) < len(everything) == len(run.artifact("instances")["granule_fit"])
    assert [p.fit for p in everything] == sorted(run.artifact("instances")["granule_fit"].tolist(), reverse=True)
    assert all(p.views >= 2 and 0 <= p.fit <= 1 and (np.diff(p.gaussians.astype(int)) > 0).all() for p in everything)
    sets = [set(p.gaussians.tolist()) for p in proposals]
    assert all(len(a & b) < 0.3 * len(a | b) for i, a in enumerate(sets) for b in sets[:i])


def test_a_table_has_a_row_for_each_object(run, monkeypatch):
    table = pytest.importorskip("pandas") and run.to_dataframe()
    objects = run.objects()
    assert table.index.tolist() == [o.id for o in objects] and table["gaussians"].tolist() == [o.gaussians for o in objects]
    np.testing.assert_allclose(table[["x", "y", "z"]], [o.center for o in objects])
    np.testing.assert_allclose(table[["size_1", "size_2", "size_3"]].prod(axis=1), [o.volume for o in objects], rtol=1e-4)
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        run.to_dataframe()


def test_a_notebook_shows_the_page(run, folder, tmp_path):
    with pytest.raises(FileNotFoundError, match="explore page --run-dir"):
        run.show(tmp_path / "none.html")
    page = tmp_path / "page.html"
    subprocess.run([PROGRAM, "explore", "page", "--run-dir", folder, "--out", page, "--quiet"], check=True)
    shown = run.show(page, height=300)._repr_html_()
    assert shown.startswith("<iframe srcdoc=") and 'height="300"' in shown
    assert html.unescape(shown.split('"')[1]) == page.read_text(encoding="utf-8")


def test_open3d_only_where_it_is(run, monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ImportError, match="pip install open3d"):
        run.to_open3d()
    fake = types.SimpleNamespace(
        geometry=types.SimpleNamespace(PointCloud=types.SimpleNamespace), utility=types.SimpleNamespace(Vector3dVector=np.asarray)
    )
    monkeypatch.setitem(sys.modules, "open3d", fake)
    cloud = run.to_open3d()
    assert cloud.points.shape == cloud.colors.shape == (len(run.labels), 3)
    assert cloud.colors.min() >= 0 and cloud.colors.max() <= 1


def test_what_is_no_run_is_refused(tmp_path, folder):
    with pytest.raises(OSError, match="no such folder"):
        cags.Run(tmp_path / "none")
    with pytest.raises(ValueError, match="not finished"):
        cags.Run(tmp_path)
    broken = tmp_path / "broken"
    broken.mkdir()
    for name in ("geometry.ply", "instances.safetensors"):
        data = bytearray((folder / name).read_bytes())
        if name.startswith("instances"):
            data[-1] ^= 1
        (broken / name).write_bytes(data)
    with pytest.raises(ValueError, match="instances.safetensors"):
        cags.Run(broken)


def test_scene_json_fits_its_schema(folder, tmp_path):
    schema = json.loads(subprocess.run([PROGRAM, "export", "schema"], check=True, capture_output=True).stdout)
    jsonschema.Draft202012Validator.check_schema(schema)
    schema = jsonschema.Draft202012Validator(schema)
    inputs = ["--geometry", folder / "geometry.ply", "--instances", folder / "instances.safetensors"]
    named = json.loads((folder / "names.json").read_text())
    scale = {"op": "scale", "from": [0, 0, 0], "to": [0, 0, 2], "metres": 1}
    edits = [{"op": "rename", "instance": 0, "name": 'a "mug"'}, scale]
    text = {"format": "instances.edits", "version": 1, "instances": named["instances"], "edits": edits}
    (tmp_path / "edits.json").write_text(json.dumps(text))
    scenes = []
    for options in [["--run-dir", folder], inputs, [*inputs, "--edits", tmp_path / "edits.json", "--up", "z"]]:
        subprocess.run([PROGRAM, "export", "scene", *options, "--out", tmp_path / "scene.json", "--overwrite", "--quiet"], check=True)
        scenes.append(json.loads((tmp_path / "scene.json").read_text()))
        schema.validate(scenes[-1])
    whole, bare, edited = scenes
    assert whole["up"] and bare["up"] is None and not bare["objects"][0]["box"]["upright"]
    assert edited["metres_per_unit"] == 0.5 and edited["objects"][0]["name"]["from"] == "edits"
    thing = whole["objects"][0]
    relation = {"subject": 0, "object": 0, "relation": "beside"}
    flat = {**thing["box"], "half_size": [-1, 1, 1]}
    for wrong in [{"version": 2}, {"up": 1}, {"objects": [{**thing, "id": -1}]}, {"objects": [{**thing, "box": flat}]}, {"relations": [relation]}]:
        assert not schema.is_valid({**whole, **wrong}), wrong
