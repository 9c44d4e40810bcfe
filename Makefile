# make demo   sets up .venv and runs the main job on cart-pole, ending with the report
# make test   sets up .venv, lints and tests; make test-slow also runs the tests of minutes
# make mission   what nocl stands by, in processes of their own: the README's lines, the paper's tables, what ships
# make pretrained   makes the controllers that ship with nocl again
# Needs Python 3.11, gcc, g++ and make; everything else comes from the package registry.

PYTHON ?= python3.11
TORCH ?= torch==2.13.0# pinned and installed first: the CPU build, where a range would take a CUDA build of gigabytes
L4CASADI ?= l4casadi==2.0.0
BIN := .venv/bin
STAMP := .venv/.set-up
FOLDERS := nocl systems solvers comparisons

export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PIP_NO_INPUT := 1
PIP := $(BIN)/python -m pip install --quiet --no-compile# saves half a minute: most modules are never imported

.PHONY: demo pretrained test test-slow mission lint set-up clean

demo: set-up
	$(BIN)/nocl run cartpole --out runs/cartpole

# One thread of torch in each of the processes: threads of several get in each other's way, and take half again as long.
test: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto -m "not slow"

test-slow: lint
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto -m "not mission"

mission: set-up
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto tests/mission

pretrained: set-up
	$(BIN)/python benchmarks/controllers.py --seeds 0 --keep nocl/pretrained --results pretrained

lint: set-up
	$(BIN)/ruff check .
	$(BIN)/mypy $(FOLDERS)

set-up: $(STAMP)

# L4CasADi has no wheel: its build needs torch, CMake < 4 and no isolation. Not from the cache of wheels, since one that was
# built beside another torch would be taken for this one.
$(STAMP): pyproject.toml
	@for tool in $(PYTHON) gcc g++; do \
	    command -v $$tool > /dev/null || { echo "$$tool was not found: install Python 3.11, gcc and g++, or set PYTHON=..."; exit 2; }; done
	$(PYTHON) -m venv .venv
	$(PIP) "$(TORCH)"
	$(PIP) -e ".[dev]"
	$(PIP) "cmake<4" ninja scikit-build "setuptools>=77" wheel
	PATH="$(CURDIR)/$(BIN):$$PATH" $(PIP) --no-build-isolation --no-cache-dir "$(L4CASADI)"
	@touch $@

clean:
	rm -rf .venv build nocl.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
