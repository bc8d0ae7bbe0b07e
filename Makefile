# Every target makes the environment it needs. Wanted: python3 (3.11 or newer), make, a package index.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/ready
PEERS := $(VENV)-peers/ready
INSTALL := -m pip install --quiet --disable-pip-version-check
# The lower bounds of pyproject.toml. Their wheels are for Python 3.11 and 3.12.
OLDEST := jax==0.8.0 jaxlib==0.8.0 jaxtyping==0.2.34 networkx==3.0 numba==0.60.0 numpy==2.0.0 matplotlib==3.9.0 scs==3.2.7 optax==0.2.4 plotly==6.0.0 tqdm==4.66.0 trimesh==4.4.0 laspy==2.6.1 lazrs==0.6.3 python-neo-lzf==0.3.5
TEST := -m pytest -n 2 --dist loadfile --no-loadscope-reorder -q

# Tests, benchmarks and notebooks on real data skip where there is none.
ifneq ($(wildcard ../shared/data),)
export TEASER_JAX_DATA ?= $(abspath ../shared/data)
endif

# Most of a test run is compilation: programs are kept beside the environment that made them.
test quick slow notebooks: export JAX_COMPILATION_CACHE_DIR ?= $(abspath $(VENV))/jax-cache
test quick slow notebooks: export JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS ?= 0.2

# Two workers, each with threads of its own for small matrices, wait for one another.
test quick slow: export OPENBLAS_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help demo test quick slow lint notebooks bench studies oldest newest wheel size clean

help: ## This list
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 12

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=...")'
	@echo "making $(VENV), once"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python $(INSTALL) --editable '.[dev]'
	@touch $@

demo: $(READY) ## Register two partial scans, and draw demo.png
	@$(BIN)/teaser-jax demo --plot demo.png

test: $(READY) ## Run the tests, without the slow ones
	@$(BIN)/python $(TEST)

quick: $(READY) ## Run the tests that compile little: a minute, for the inner loop
	@$(BIN)/python $(TEST) -m "not slow and not long"

slow: export TEASER_JAX_OPTIMIZED ?= 1
slow: $(READY) ## Run the slow tests
	@$(BIN)/python $(TEST) -m slow

lint: $(READY) ## Check style, format and types
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

notebooks: $(READY) ## Run the notebooks and keep their output
	@$(BIN)/python notebooks/run.py

$(PEERS): pyproject.toml
	@echo "making $(VENV)-peers, once"
	@$(PYTHON) -m venv $(VENV)-peers
	@$(VENV)-peers/bin/python $(INSTALL) --editable '.[dev]' kiss-matcher open3d-cpu
	@touch $@

bench: $(PEERS) ## Run the benchmarks beside the peers, for instance: make bench ARGS="--quick --only speed"
	@$(VENV)-peers/bin/python -m benchmarks $(ARGS)

studies: $(PEERS) ## Run the paper's studies, which takes hours, and write benchmarks/PAPER.md
	@$(VENV)-peers/bin/teaser-jax study all --folder benchmarks/studies $(ARGS)
	@$(VENV)-peers/bin/python -m benchmarks.paper benchmarks/studies -o benchmarks/PAPER.md

oldest: ## Test against the oldest supported packages
	@rm -rf $(VENV)-oldest && $(PYTHON) -m venv $(VENV)-oldest
	@$(VENV)-oldest/bin/python $(INSTALL) --editable '.[dev]' $(OLDEST)
	@$(VENV)-oldest/bin/python $(TEST)

newest: ## Test against the newest packages
	@rm -rf $(VENV)-newest && $(PYTHON) -m venv $(VENV)-newest
	@$(VENV)-newest/bin/python $(INSTALL) --upgrade --upgrade-strategy eager --editable '.[dev]'
	@$(VENV)-newest/bin/python $(TEST)

define QUICKSTART
import teaser_jax as tj
problem = tj.synthetic.random_problem(0)
result = tj.register(problem.src, problem.dst, noise_bound=problem.noise_bound)
print(tj.__file__, result, sep="\n")
assert result.ok and (result.inliers == problem.inliers).all()
endef
export QUICKSTART

wheel: $(READY) ## Build the wheel, install it alone and run the quickstart far from the source
	@rm -rf dist $(VENV)-wheel
	@$(BIN)/python -m build --quiet --outdir dist . >/dev/null
	@! $(BIN)/python -m zipfile -l dist/*.whl | sed 1d | grep -v '^teaser_jax[-/]'
	@$(PYTHON) -m venv $(VENV)-wheel
	@$(VENV)-wheel/bin/python $(INSTALL) dist/*.whl
	@cd / && $(abspath $(VENV)-wheel)/bin/python -I -c "$$QUICKSTART"
	@cd / && $(abspath $(VENV)-wheel)/bin/teaser-jax --version

size: ## State the size of a plain pip install .
	@rm -rf $(VENV)-size && $(PYTHON) -m venv $(VENV)-size
	@$(VENV)-size/bin/python $(INSTALL) .
	@cd $(VENV)-size/lib/python*/site-packages && \
	    du -sm --exclude='pip*' --exclude='setuptools*' -- * | sort -rn | awk 'NR <= 8 { print "  " $$1 " MB  " $$2 }' && \
	    du -sm --exclude='pip*' --exclude='setuptools*' . | awk '{ print $$1 " MB in all, pip and setuptools left out" }'

clean: ## Remove whatever the targets make
	@rm -rf .venv* build dist demo.png .pytest_cache .hypothesis .mypy_cache .ruff_cache
	@find . -name __pycache__ -prune -exec rm -rf {} +
