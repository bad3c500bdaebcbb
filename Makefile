# `make demo` and `make test` set up everything they need; the rest builds on the same environment.
PYTHON ?= python3
BIN := .venv/bin
CORE := .venv/.core
READY := .venv/.ready
KERNELS := .venv/.kernels
TIMED := .ci/timed

.PHONY: install-core install demo test timed-lint timed-kernels test-all lint size cold-reading stability validate-speckle speckle-time fuzz chaos side-by-side effects accuracy accuracy-terrain draw-groups stopping frozen promise detectors peers peers-physics scaling plan-honesty validation instruments docs pictures fields ids scale million lock clean
SEED ?= 1

# What grids and figures need; the demo needs no more.
$(CORE): pyproject.toml requirements.lock
	$(PYTHON) -c 'import sys; sys.exit("sweep needs Python >= 3.11" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv .venv
	$(TIMED) "core" $(BIN)/pip install --quiet --constraint requirements.lock --editable .
	touch $@

$(READY): $(CORE)
	$(TIMED) "install" $(BIN)/pip install --quiet --requirement requirements.lock
	touch $@

install-core: $(CORE)

install: $(READY)

# The studies of README's pictures, computed and drawn.
DEMO := quickstart descent
demo: $(CORE)
	for name in $(DEMO); do \
	  $(BIN)/sweep run experiments/$$name.yaml --store results/$$name.zarr --overwrite && \
	  $(BIN)/sweep figures results/$$name.zarr || exit 1; done

# The pictures of README and docs/, from the present model: a test tells when they are out of date.
pictures: $(CORE)
	$(BIN)/python docs/pictures.py

test: $(READY)
	$(MAKE) --no-print-directory --jobs 3 --output-sync timed-lint timed-kernels
	$(TIMED) "tests" $(BIN)/pytest -n auto --dist worksteal --durations 12

timed-lint:
	$(TIMED) "lint" $(MAKE) lint

timed-kernels:
	$(TIMED) "compiling" $(MAKE) $(KERNELS)

test-all: $(READY)
	$(MAKE) --jobs 2 --output-sync $(KERNELS)
	$(BIN)/pytest -n auto --dist worksteal -m '' --hypothesis-profile anew

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --disable-error-code arg-type --disable-error-code index benchmarks

# Once for all processes of tests, which would each compile the same.
$(KERNELS): $(READY) sweep/kernel_cache.py $(shell grep -rl --include='*.py' njit sweep)
	$(MAKE) compile-grids compile-flights
	touch $@

compile-%: $(READY)
	$(BIN)/python tests/compile_kernels.py $*

# Lines, modules and compiled functions, and the modules that a run of a grid and of a flight enters.
size: $(READY)
	$(BIN)/python tests/code_size.py
	$(BIN)/python tests/list_entered_modules.py experiments/quickstart.yaml experiments/square_low_descent.yaml

# 100 names and 60 docstrings, drawn by SEED, for a reader who has not seen the code.
cold-reading: $(READY)
	$(BIN)/python benchmarks/cold_reading.py --seed $(SEED)

stability: $(READY)
	PYTHONPATH=tests $(BIN)/python tests/stability/write_stability_page.py

# 200 random specs in developed speckle, compared with drawn scatterers; some six minutes. SEED has others.
validate-speckle: $(READY)
	PYTHONPATH=tests OPENBLAS_NUM_THREADS=1 $(BIN)/python tests/validate_speckle.py --seed $(SEED)

# 10,000 random specs and 10,000 spoilt ones, some 40 minutes; failures are shrunk and shown.
fuzz: $(READY)
	FUZZ=10000 $(BIN)/pytest tests/fuzz/test_fuzz.py -k "computed or spoilt" --hypothesis-seed $(SEED)

# Some 200 kills of clients, workers, nannies, schedulers and commands, and power cuts where the machine
# allows them, ten minutes: docs/reliability.md.
KILLS ?= 210
chaos: $(READY)
	$(BIN)/python tests/faults/chaos.py --kills $(KILLS) --seed $(SEED)

# What the engine costs beside others', and what a second worker brings; on a quiet machine.
peers: $(READY)
	$(BIN)/pip install --quiet joblib xyzpy
	$(BIN)/python benchmarks/engine_comparison.py

# Points a second and memory side by side with drawn records by NumPy, docs/peers.md; ten minutes.
peers-physics: $(READY)
	$(BIN)/python benchmarks/peers_physics.py

scaling: $(READY)
	$(BIN)/python benchmarks/worker_scaling.py

# What plans of flights predict and take, and what their runs take; some ten minutes.
plan-honesty: $(READY)
	$(BIN)/python benchmarks/plan_honesty.py

effects: $(READY)
	$(BIN)/python benchmarks/effects_page.py

# Time a point against model 19, ratios of one run on one machine.
side-by-side: $(READY)
	$(BIN)/pip install --quiet embreex  # which model 19 casts rays with
	$(BIN)/python benchmarks/version_timing.py

# Smooth points and flights against a commit, and points in developed speckle against smooth ones;
# a quarter of an hour.
EARLIER ?= 7881fb1
speckle-time: $(READY)
	$(BIN)/python benchmarks/version_timing.py --group speckle --earlier $(EARLIER) --rounds 3

scale: $(READY)
	$(BIN)/python benchmarks/engine_limits.py

million: $(READY)
	$(BIN)/python benchmarks/million_blocks.py

stopping: $(READY)
	$(BIN)/python benchmarks/stopping_rule.py

# Answers of this version against those of model 19, some 40,000 points, first computed where they
# are missing. A quarter of an hour each.
FROZEN := results/frozen_9b29f45
POINTS ?= 1000
frozen: $(READY)
	mkdir -p results
	test -e $(FROZEN) || git worktree add --detach $(FROZEN) 9b29f45
	test -e $(FROZEN).npz || PYTHONPATH=$(FROZEN) $(BIN)/python benchmarks/frozen_answers.py \
	  write $(FROZEN).npz --points $(POINTS)
	$(BIN)/python benchmarks/frozen_answers.py compare $(FROZEN).npz --points $(POINTS)

promise: $(READY)
	$(BIN)/python benchmarks/tolerance_page.py

detectors: $(READY)
	$(BIN)/python benchmarks/detectors_page.py

accuracy: $(READY)
	$(BIN)/python benchmarks/accuracy_page.py

draw-groups: $(READY)
	$(BIN)/python benchmarks/draw_group_efficiency.py

# Beamlets in a flight over rough terrain, a section of docs/accuracy.md; ten minutes.
accuracy-terrain: $(READY)
	$(BIN)/python benchmarks/rough_terrain_beamlets.py

# docs/validation.md from the stores in results/; those that are missing are computed first.
validation: $(READY)
	for name in $$($(BIN)/python benchmarks/validation_page.py --missing); do \
	  $(BIN)/sweep run experiments/$$name.yaml || exit 1; done
	$(BIN)/python benchmarks/validation_page.py

# docs/instruments.md: each instrument of the library, published against simulated; a minute or two.
instruments: $(READY)
	$(BIN)/python benchmarks/instruments_page.py

# The site, from the pages in docs/, in build/site; what is amiss in a page is an error.
docs: $(READY)
	$(BIN)/pip install --quiet --editable '.[docs]'
	$(BIN)/sphinx-build -W --keep-going -b html docs build/site

fields: $(READY)
	$(BIN)/python docs/field_reference.py
	$(BIN)/python docs/variable_reference.py
	$(BIN)/python docs/effect_reference.py

# The ids of the shipped experiments that a test compares, after a change of fields.
ids: $(READY)
	$(BIN)/python tests/spec/write_experiment_ids.py

clean:
	rm -rf .venv results build *.egg-info

lock:
	$(PYTHON) -m venv .venv-lock
	.venv-lock/bin/pip install --quiet --editable '.[test,docs]'
	(echo '# Exact versions of every dependency, tests and linters included; `make lock` renews it.'; \
	 .venv-lock/bin/pip freeze --exclude-editable) > requirements.lock
	rm -rf .venv-lock
