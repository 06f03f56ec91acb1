# `make demo` and `make test` do all of the set-up on a fresh machine, and nothing twice.
# The first run downloads and installs 9 GB of packages, which takes some 7 minutes on 2 cores.

# Torch's OpenMP threads spin while they wait for each other. On cores that something else uses too, two spinning threads
# are many times slower than one (measured: 6.2 s instead of 0.16 s); passive threads sleep instead. A value set outside wins.
export OMP_WAIT_POLICY ?= PASSIVE
export PIP_DISABLE_PIP_VERSION_CHECK = 1

VENV := .venv
PYTHON ?= $(shell .ci/find-python)
DEMO_OUTPUT ?= outputs/demo
INSTALLED := $(VENV)/.installed

.PHONY: help install demo test test-slow lint format clean
.DELETE_ON_ERROR:

help: ## Show these lines.
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 20

install: $(INSTALLED) ## Create .venv and install everything.

# The stamp is younger than what it depends on exactly if the environment matches it.
$(INSTALLED): pyproject.toml constraints.txt
	@.ci/create-venv "$(PYTHON)" "$(VENV)"
	@echo "Installing into $(VENV); the first time this takes about 7 minutes."
	$(VENV)/bin/python -m pip install --constraint constraints.txt --editable '.[dev]'
	$(VENV)/bin/python -m method_configs.environment --mend
	@touch $@

demo: $(INSTALLED) ## Complete a small room on this machine: report.png and metrics.json in outputs/demo.
	@$(VENV)/bin/fillerbuster compile || echo "Splats are drawn by torch alone, which takes about twice as long."
	$(VENV)/bin/fillerbuster demo --output $(DEMO_OUTPUT)

test: $(INSTALLED) ## Run the tests (minutes).
	$(VENV)/bin/python -m pytest

test-slow: $(INSTALLED) ## Run the long tests too.
	$(VENV)/bin/python -m pytest -m 'slow or not slow'

lint: $(INSTALLED) ## Check style and types.
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/pyright

format: $(INSTALLED) ## Mend style.
	$(VENV)/bin/ruff check --fix .
	$(VENV)/bin/ruff format .

clean: ## Remove the environment and caches (outputs stay).
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis build dist *.egg-info
