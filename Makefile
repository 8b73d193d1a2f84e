# make help       this list
# make demo       render, solve, correct and score one sequence; ends with the path of its report
# make test       format, lint, types, layers and tests; SLOW=1 adds those marked slow, as CI does
# make test-extras  install rerun-sdk, torch and datasets (1 GB and more), and run the tests that need them
# make test-gpu   tests of the renderers, on an NVIDIA GPU
# make attack     kills, failing file operations, damaged inputs, faults for verify: takes hours
# make bounds     tests of the compiled functions, with a check of every index: 5 minutes
# make sample     the release's sample of data, build/rsbench-sample.zip
# make docs       the documentation site, in build/docs; warnings are errors
# make reference  commands.md and cards.md from the code, tables and pictures of results-*.md from results/
# make lock       renew both files of constraints from pyproject.toml (needs uv)
# make clean      remove .venv and caches
# Needs Python >= 3.11 with pip and venv. `make demo PYTHON=/path/to/python` chooses one.

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
TOOLS := $(VENV)/.tools-installed
PIP := $(BIN)/python -m pip --disable-pip-version-check
CANDIDATES = $(or $(PYTHON),python3 python3.14 python3.13 python3.12 python3.11)
COMPILE := from rsbench.solvers.refined import warm_up; warm_up(["linear", "twist"])
OURS := import os, sys; from importlib.util import find_spec; \
  found = getattr(find_spec("rsbench"), "origin", None); \
  ours = os.path.samefile(os.path.dirname(found), "rsbench") if found else not os.path.exists("$(STAMP)"); \
  whose = f"imports rsbench from {os.path.dirname(found)}" if found else "was made for a checkout that moved"; \
  sys.exit(None if ours else f"make: $(VENV) {whose}: remove $(VENV) (make clean), and make again")
SUITABLE := import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))

.PHONY: help demo test test-extras test-gpu attack bounds sample docs reference lock clean here
.DELETE_ON_ERROR:
.DEFAULT_GOAL := demo

help:
	@sed -n 's/^# \(make [a-z-]* \)/\1/p' $(firstword $(MAKEFILE_LIST))

demo: $(STAMP)
	@PYTHONDONTWRITEBYTECODE= $(BIN)/rsbench demo

# Types are checked while kernels are compiled and the first tests run, in two processes, the longest tests first.
# Bytecode is kept whatever the environment says, since each process that a test starts would compile it again.
test: $(TOOLS)
	@echo "== format"; $(BIN)/ruff format --check .
	@echo "== lint";   $(BIN)/ruff check .
	@echo "== layers"; $(BIN)/lint-imports
	@echo "== types, beside compiling and the tests"; \
	$(BIN)/pyrefly check --progress-bar no --python-interpreter-path $(BIN)/python & types=$$!; \
	$(BIN)/python -c '$(COMPILE)' || { kill $$types; exit 1; }; \
	PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 --no-loadscope-reorder $(if $(SLOW),,-m "not slow"); tests=$$?; \
	wait $$types || { echo "types: failed, see above" >&2; exit 1; }; exit $$tests

# Not locked: the newest versions that pyproject.toml allows.
test-extras: $(TOOLS)
	@$(PIP) install --quiet -e '.[view,torch]' datasets --no-build-isolation
	@NO_SKIPS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest tests/interop/test_view.py \
	  tests/interop/test_export_training.py tests/interop/test_export_layouts.py tests/test_learn_flow.py \
	  tests/jobs/test_dask_jobs.py tests/storage/test_s3.py

test-gpu: $(TOOLS)
	@$(BIN)/python -c 'import sys; from rsbench.renderers.backend import probe_cuda; found = probe_cuda(); \
	  sys.exit(None if found.ok else f"make: no GPU to test: {found.reason}")'
	@RSBENCH_VARIANT=cuda OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 -k "not moving" tests/renderers tests/dataset

attack: $(TOOLS)
	@PYTHONPATH=tests $(BIN)/python -m attack --write docs/explanation/reliability.md

# Compiled functions check no index: one beyond an array reads any memory, and results differ from run to run.
bounds: $(TOOLS)
	@NUMBA_BOUNDSCHECK=1 NUMBA_CACHE_DIR="$(CURDIR)/build/bounds" OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 \
	  -m "not slow" tests/core tests/components tests/vision tests/capture tests/solvers tests/pipeline tests/verification

sample: $(STAMP)
	@$(BIN)/python benchmarks/release_sample.py build/rsbench-sample.zip

docs: $(TOOLS)
	@$(BIN)/sphinx-build -W --keep-going -q -b html docs build/docs
	@echo "site: $(CURDIR)/build/docs/index.html"

reference: $(STAMP)
	@$(BIN)/python docs/make_reference.py
	@$(BIN)/python docs/make_results.py

# Refuse a .venv whose rsbench is that of another checkout, or that was moved with its checkout: installing would
# change what the other one runs.
here:
	@if [ -x $(BIN)/python ]; then $(BIN)/python -I -c '$(OURS)'; fi

# What users need; a killed `python -m venv` leaves a venv without a working pip: it is made again.
# Without bytecode, which Python makes of what a command imports: of everything it takes 150 MB and ten seconds.
$(STAMP): constraints.txt pyproject.toml | here
	@if ! $(PIP) --version >/dev/null 2>&1; then \
	  for python in $(CANDIDATES); do \
	    if "$$python" -c '$(SUITABLE)' 2>/dev/null; then found=$$python; break; fi; \
	  done; \
	  if [ -z "$$found" ]; then \
	    echo "make: no Python >= 3.11 with pip and venv among: $(CANDIDATES) (PYTHON=/path/to/python chooses)" >&2; exit 1; \
	  fi; \
	  echo "Creating $(VENV) with $$("$$found" --version)"; \
	  "$$found" -m venv --clear $(VENV); \
	fi
	@echo "Installing the locked dependencies into $(VENV) (a minute or two the first time)"
	@$(PIP) install --quiet --no-compile --require-hashes -r constraints.txt
	@$(PIP) install --quiet --no-deps --no-build-isolation -e .
	@touch $@

# What tests, checks and the documentation need besides.
$(TOOLS): constraints-dev.txt $(STAMP)
	@echo "Installing what tests and documentation need (a minute or two the first time)"
	@$(PIP) install --quiet --require-hashes -r constraints-dev.txt
	@touch $@

# The tools' versions come first, since those of users are among them.
LOCK = uv pip compile pyproject.toml --extra install --universal --python-version 3.11 \
	  --generate-hashes --no-annotate --no-header --quiet
lock:
	@command -v uv >/dev/null || { echo "make: 'make lock' needs uv, which is not installed" >&2; exit 1; }
	$(LOCK) --extra dev --extra docs --output-file constraints-dev.txt
	$(LOCK) --constraints constraints-dev.txt --output-file constraints.txt

clean:
	rm -rf $(VENV) .ruff_cache .pytest_cache .hypothesis .import_linter_cache dist build
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
