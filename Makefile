# Everything a newcomer needs: `make demo` and `make test`. Both set up .venv by themselves; `make setup` also compiles.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# `make LOCK=requirements.lock`: the versions that CI takes, which were last seen to work together.
LOCK ?=
PIP = $(BIN)/pip install --quiet --disable-pip-version-check $(if $(LOCK),-c $(LOCK))
LOWEST := out/lowest

# Extras, e.g. dev+catalog: by uv, in a fifth of pip's time, or else by pip. uv has its own setting of an index, UV_DEFAULT_INDEX.
comma := ,
editable = -e '.[$(subst +,$(comma),$(1))]'
install = $(BIN)/uv pip install --quiet --compile-bytecode --python $(BIN)/python $(if $(LOCK),-c $(LOCK)) $(editable) || $(PIP) $(editable)

$(READY): pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "skysim needs Python 3.11 or newer")'
	$(PYTHON) -m venv .venv
	-$(PIP) uv
	$(call install,dev+catalog)
	touch $@

# Extras of single targets, each installed once. `make extras`: all that CI needs, by one call.
EXTRA := .venv/.extra-
$(EXTRA)%: $(READY)
	$(call install,$*)
	touch $@

CI_EXTRAS := docs s3+query browser
extras: $(READY)
	$(call install,$(subst $(eval ) ,+,$(CI_EXTRAS)))
	touch $(addprefix $(EXTRA),$(CI_EXTRAS))

.PHONY: compile extras baseline bench accept demo test test-slow test-long oracle test-browser test-lowest lock fuzz fuzzer mutants lint pictures studies papers stale docs figures gui recompile setup clean
setup: $(READY)
	NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.helpers.compilation --basic

demo: $(READY)
	$(BIN)/skysim run afit_simsat --out out/afit_simsat
	$(BIN)/skysim run afit_simsat_ideal --frames 20 --out out/afit_simsat_ideal
	$(BIN)/skysim run shefex2 --out out/shefex2

# All compiled code that the tests need, in two processes; `make test` compiles what most tests need by itself.
compile: $(READY)
	NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m tests.helpers.compilation

# Kept bytecode: the tests start some hundred processes, each of which would compile the sources again.
PYTEST = PYTHONDONTWRITEBYTECODE= NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2

test: $(READY)
	$(PYTEST) --dist worksteal -m "not slow and not compiles and not long and not browser"

test-slow: $(READY) $(EXTRA)s3+query
	$(PYTEST) --dist worksteal -m "(slow or compiles) and not long and not browser"

test-long: $(READY)
	$(PYTEST) --dist worksteal -m long

# What a refactoring must not change: frames, truth, solutions, studies, JSON, streams, surveys, messages. RECORD=1 after
# an intended change, which goes into tests/baseline/CHANGES.md. AREAS="scenes messages"; ALL=1 adds what takes minutes.
baseline: $(READY)
	$(BIN)/python -m tests.baseline $(AREAS) $(if $(RECORD),--record) $(if $(ALL),--all)

# Other people's instruments. astrometry.net is no Python package: docs/findings/oracles.md tells how to get it.
oracle: $(READY)
	$(PIP) -e '.[oracle]'
	$(BIN)/python -m pytest -rs -m "not long" tests/oracles

# Our speed beside other people's tools, which are installed first. Without AREAS=... the quick part of every area.
bench: $(READY)
	$(PIP) -e '.[oracle]'
	$(PIP) --no-deps cedar-solve==0.5.1 pillow  # it pins an old numpy; benchmarks/peers.py
	$(BIN)/python -m benchmarks $(AREAS)

# Every bar that a benchmark or a long test holds, in out/accept.json: hours; stopped, it goes on. QUICK=1: a minute.
accept: $(READY)
	NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks accept $(if $(QUICK),--quick)

gui: $(READY)
	$(BIN)/skysim gui

pictures: demo
	$(BIN)/python docs/site/pictures.py

STUDIES := dome_shape dome_size led_count led_brightness needed_leds rate_smear false_stars moon_and_planets ground_night dome_reflections error_budget end_to_end
studies: $(READY)
	for name in $(STUDIES); do $(BIN)/skysim study run $$name || $(BIN)/skysim study resume $$name || exit 1; done
	$(BIN)/skysim study optimize dome_without_codes
	$(BIN)/skysim study optimize dome_for_the_money
	$(BIN)/python docs/site/studies.py

papers: $(READY)
	mkdir -p out
	$(BIN)/skysim reproduce all --quick --json > out/papers.json
	$(BIN)/python docs/site/afit_fit.py > out/afit_fit.txt
	$(BIN)/python docs/site/papers.py out/papers.json out/afit_fit.txt

# The findings pages whose code has changed since they were made, and the commands that make them again.
stale: $(READY)
	$(BIN)/python docs/site/stale.py

# The site, in out/site, with the reference of commands, keys and responses from the code. Nothing in it is fetched
# from elsewhere.
docs: $(READY) $(EXTRA)docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

figures: $(READY)
	$(BIN)/python docs/site/figures.py

# The lab's page in Chromium. Where that is missing the tests say so and are skipped.
test-browser: $(READY) $(EXTRA)browser
	$(PYTEST) --dist loadfile -m browser tests/apps/gui tests/apps/live tests/docs -rs

# Versions that resolve today, for CI; and the tests on the lowest that pyproject.toml allows.
lock: $(READY)
	$(BIN)/pip install --quiet --upgrade --upgrade-strategy eager -e '.[dev,catalog,browser,docs,s3,query]'
	$(BIN)/pip freeze --exclude-editable > requirements.lock

test-lowest:
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/pip install --quiet --disable-pip-version-check uv
	$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct -e '.[dev,catalog]'
	NUMBA_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(LOWEST)/bin/python -m pytest -n 2 --dist worksteal -m "not long and not browser"

# Files that nobody wrote by hand, for every parser; findings are kept in out/fuzz. Where the extra cannot be had it goes
# on by mutation alone, and says so.
FUZZ_S ?= 60
fuzz: fuzzer
	$(BIN)/python -m tests.fuzz $(FUZZ_S)

fuzzer: $(READY)
	-$(call install,fuzz)

# How many of MUTANTS random small changes of the code the tests notice: docs/findings/mutants.md. It takes an hour, and
# goes on where it was stopped; `AGAIN=--again` tries the survivors once more, after tests were added. Of some packages
# or modules: PACKAGES="skysim/sources/air.py skysim/experiments/datasheet".
MUTANTS ?= 300
SEED ?= 1
mutants: $(READY)
	$(call install,mutants)
	$(BIN)/python -m tests.mutants $(MUTANTS) $(SEED) $(PACKAGES) $(AGAIN)

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

recompile:
	find skysim estimator tests -name '*.nb[ic]' -delete

clean:
	rm -rf out .venv
