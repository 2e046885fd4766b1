# All targets work from a fresh clone with Python >= 3.11 and make; they create .venv first if they need it.
PYTHON ?= python3
# Another folder for another Python: make test VENV=.venv-3.13 PYTHON=python3.13
VENV ?= .venv
BIN := $(VENV)/bin
SETTINGS ?=
# Huge pages for large buffers (glibc; ignored elsewhere): a train step takes 0.87 of the time. The bench measures both.
train weights: export GLIBC_TUNABLES ?= glibc.malloc.hugetlb=1
# A test run starts hundreds of processes: from its source the package takes each of them two seconds longer to import.
unexport PYTHONDONTWRITEBYTECODE
# XLA raises its errors; what it logs besides is an alarm at every compilation of more than two minutes.
export TF_CPP_MIN_LOG_LEVEL ?= 3

.PHONY: help setup train test test-slow test-all bench chart compare papers hard-cases mutants results cycles lint format docs weights blender-addon clean

help:  ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 14

# Not compiled: of eleven thousand installed modules few are imported, and those are compiled then. uv does the same.
setup: $(VENV)/ready  ## .venv with the exact versions of constraints.txt (uses uv if it is installed, else pip)

$(VENV)/ready: pyproject.toml constraints.txt
	@echo "Setting up $(VENV) (Python packages of constraints.txt; a minute or two) ..."
	@if command -v uv >/dev/null 2>&1; then \
		uv venv --quiet --allow-existing --python $(PYTHON) $(VENV) && \
		uv pip install --quiet --python $(BIN)/python -c constraints.txt --group dev -e '.[render,train,peers,onnx,onednn,oidn,farm]'; \
	else \
		$(PYTHON) -m venv $(VENV) && \
		$(BIN)/python -m pip install --quiet --upgrade -c constraints.txt pip && \
		$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt --group dev -e '.[render,train,peers,onnx,onednn,oidn,farm]'; \
	fi
	@touch $@

train: setup  ## render clips, train the denoiser and its ablations, evaluate, write a report
	$(BIN)/python -m experiments.papers.ablation $(SETTINGS)

weights: setup  ## train the shipped weights again (hours; resumable)
	$(BIN)/python -m experiments.papers.weights --ship $(SETTINGS)

test: setup  ## the tests (minutes)
	$(BIN)/python -m pytest -n 2 --dist worksteal -q -m "not slow" $(SETTINGS)

test-slow: setup  ## the slow tests: real training runs, the notebook, real processes
	$(BIN)/python -m pytest -n 2 --dist worksteal -q -m slow $(SETTINGS)

test-all: setup  ## both, in one run: tests that share a module share what it compiles
	$(BIN)/python -m pytest -n 2 --dist worksteal -q $(SETTINGS)

hard-cases: setup  ## run every operation and denoiser on every hard case: runs/hard-cases/table.html
	$(BIN)/python -m tests.hard_cases $(SETTINGS)

mutants: setup  ## change the code in known wrong ways and see that tests fail (an hour on two cores; SETTINGS=NAME for some)
	$(BIN)/python -m tests.mutants $(SETTINGS)

# Common alternatives to compare with. Only a CPU build of PyTorch is installed, from pip's configured index or else
# through uv from PyTorch's own index: the default build brings gigabytes of CUDA packages.
$(VENV)/tools: $(VENV)/ready
	@echo "Adding PyTorch's CPU build to compare with ..."
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null
	@$(BIN)/python -m pip install --quiet --no-compile -c constraints.txt torch 2>/dev/null || \
		uv pip install --quiet --python $(BIN)/python --torch-backend cpu -c constraints.txt torch 2>/dev/null || \
		echo "no CPU build of PyTorch could be installed: its rows will be left out"
	@touch $@

# Blender as a Python package asks for Python 3.11 and NumPy 1: an environment of its own, which nothing else needs.
.venv-cycles/ready: experiments/cycles/requirements.txt
	@echo "Setting up .venv-cycles (Blender's package bpy: 400 MB) ..."
	@if command -v uv >/dev/null 2>&1; then \
		uv venv --quiet --allow-existing --python 3.11 .venv-cycles && \
		uv pip install --quiet --python .venv-cycles/bin/python -r experiments/cycles/requirements.txt; \
	else \
		python3.11 -m venv .venv-cycles && \
		.venv-cycles/bin/python -m pip install --quiet --no-compile -r experiments/cycles/requirements.txt; \
	fi
	@touch $@

cycles: .venv-cycles/ready  ## render clips with Cycles into runs/cycles: the test set first; resumable (days)
	nice .venv-cycles/bin/python -m experiments.cycles render --set test train validation -o runs/cycles $(SETTINGS)

bench: $(VENV)/tools  ## time operations, steps and training, compared with PyTorch and Open Image Denoise: runs/bench.json
	$(BIN)/python -m experiments.speed.bench $(SETTINGS)

chart: $(VENV)/tools  ## error against time for every way to make an image: runs/chart/chart.html
	$(BIN)/python -m experiments.speed.chart $(SETTINGS)

papers: setup  ## the tables of the papers on learned denoisers, on small settings: runs/papers/report.md (tens of minutes)
	$(BIN)/python -m experiments.papers.learned $(SETTINGS)

compare: $(VENV)/tools  ## the filters side by side, errors and times: runs/compare/table.md (SETTINGS="SCENES" adds rooms)
	$(BIN)/python -m experiments.papers.classical $(SETTINGS)

results: setup  ## docs/results/index.md and the tables of the README, from docs/results/*.json
	$(BIN)/python -m experiments.results_page

blender-addon:  ## build the zip of the Blender extension into dist/
	$(PYTHON) examples/blender/build.py -o dist

lint: setup  ## ruff and the type checker
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: setup  ## sort imports and format the code with ruff
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: setup  ## build the reference pages from the docstrings into site/
	@if command -v uv >/dev/null 2>&1; then uv pip install --quiet --python $(BIN)/python -c constraints.txt --group docs; \
	else $(BIN)/python -m pip install --quiet -c constraints.txt --group docs; fi
	$(BIN)/python -m mkdocs build --strict

clean:  ## delete the environment and everything rendered and trained
	rm -rf .venv .venv-* runs data site
