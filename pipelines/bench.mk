# Benchmarks of one part each; `make bench` is the one of them all. What they write is in out/bench.

# PLYs to measure besides the synthetic scenes.
SPLATS ?=
# The rasteriser per pixel-Gaussian pair on one core: raster.json.
bench-raster:
	$(CARGO) bench -p gs-raster --bench raster -- $(abspath $(SPLATS)) $(CURDIR)/out/bench/raster.json

# gs-geom's quality for the time: geom.json, geom.md, geom.svg.
bench-geom:
	scripts/bench_geom.sh

# gs-geom's cost against Gaussians, pixels and threads: growth.json.
bench-growth:
	scripts/bench_growth.sh

# gs-geom's memory forecast beside measured peaks: memory.md.
bench-memory:
	scripts/bench_memory.sh

# feat-train at a million Gaussians: train.json.
bench-train:
	$(CARGO) bench -p feat-train --bench train

# Stages 2 to 4 on 1 and 3 million Gaussians and 300 photographs (needs Python with numpy: PYTHON; half an hour): scale/scale.md.
bench-scale: build
	scripts/bench_scale.sh

# Anchors and neighbours beside fpsample and pykdtree (needs Python; POSITIONS=points or file.npy): graph.json.
POSITIONS ?= 1000000
bench-graph:
	$(CARGO) build --release -p graph-precompute --benches
	@test -x out/bench/python/bin/python || { python3 -m venv out/bench/python \
	  && out/bench/python/bin/pip install -q numpy scipy fpsample pykdtree; }
	out/bench/python/bin/python scripts/bench_graph.py $(POSITIONS) out/bench/graph.json

# mask-embed masks: the default beside every point of the grid, on PHOTOGRAPHS=folder (else 4 ray-traced ones): sam.json.
bench-sam: build
	@test -n "$$PHOTOGRAPHS" || test -d out/bench/sam/images || target/release/synth-scene --out out/bench/sam --family kitchen \
	  --seed 3 --objects 24 --views 4 --width 640 --height 480 --points 1000 --corruption exact
	$(CARGO) bench -p mask-embed --bench sam -- "$$(realpath "$${PHOTOGRAPHS:-out/bench/sam/images}")" $(CURDIR)/models \
	  $(CURDIR)/out/bench/sam.json

# HDBSCAN from Python beside the field's others, 10,000 to 1,000,000 points (BENCH_PYTHON_ARGS; hours): docs/results/python.md's table.
bench-python: wheel
	@test -x out/bench/python-hdbscan/bin/python || { python3 -m venv out/bench/python-hdbscan \
	  && out/bench/python-hdbscan/bin/pip install -q scikit-learn hdbscan fast_hdbscan hdbscan-rs; }
	out/bench/python-hdbscan/bin/pip install -q --no-deps --force-reinstall out/wheel/cags-*.whl
	out/bench/python-hdbscan/bin/python scripts/bench_python.py out/bench/python/hdbscan.md $(BENCH_PYTHON_ARGS)

# A query over a million Gaussians and 500 instances: query.json.
bench-query:
	$(CARGO) bench -p eval --bench query -- --out $(CURDIR)/out/bench/query.json

# explore's answers to clicks and texts, and the size of its page, at GAUSSIANS Gaussians made of RUN's: explore.json.
RUN ?= out/demo
GAUSSIANS ?= 1000000
bench-explore:
	$(CARGO) bench -p explore --bench latency -- $(abspath $(RUN)) $(CURDIR)/out/bench/explore.json $(GAUSSIANS)

# Synthetic masks beside real ones (MASKS=folder FOOTPRINTS=file): granularity.md.
bench-granularity: build
	scripts/bench_granularity.sh
