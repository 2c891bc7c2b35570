# Every target makes .venv ready first (.ci/setup.sh): nothing needs to be installed or activated by hand.
SHELL := /bin/bash
RUN := ./.ci/setup.sh
WORKERS ?= 2# test processes at a time; one thread each
SPREAD := --dist loadfile --no-loadscope-reorder# the long files first, by their folders' names
SEED := $(or $(SEED),$(shell echo $$RANDOM))# of the property tests in `make slow`
ARGS ?=# handed on to the target's command, e.g. make test ARGS='-k losses'

export HF_HUB_OFFLINE ?= 1
test slow: export OMP_NUM_THREADS = 1

.DEFAULT_GOAL := help
.PHONY: help demo demo-arm demo-so101 test slow check docs format setup pins release-check compatibility clean distclean

help: ## show the targets
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: ## see it work: a small training run with its report, in outputs/demo
	@$(RUN) .venv/bin/python -m cqn_train.demo.station --output_dir=outputs/demo $(ARGS)

demo-arm: ## the same on a simulated arm: lerobot-record, the operator's page, a simulated person; in outputs/demo-arm
	@$(RUN) .venv/bin/python -m cqn_train.demo.arm --output_dir=outputs/demo-arm $(ARGS)

demo-so101: ## two virtual SO-101 from setting up their motors to a better policy, by LeRobot's commands; in outputs/demo-so101
	@$(RUN) .venv/bin/python -m cqn_train.demo.so101 --output_dir=outputs/demo-so101 $(ARGS)

test: ## the fast tests
	@$(RUN) .venv/bin/python -m pytest -n $(WORKERS) $(SPREAD) --durations=10 $(ARGS)

slow: ## the tests that train for minutes, and the property tests with examples drawn anew; SEED=... draws them again
	@echo "Property tests: make slow SEED=$(SEED)"
	@CQN_EXAMPLES=random $(RUN) .venv/bin/python -m pytest -m 'slow or hypothesis' --hypothesis-seed=$(SEED) \
	  -n $(WORKERS) $(SPREAD) --timeout 3600 $(ARGS)

check: ## lint, formatting, types, the reference, import rules
	@$(RUN) .venv/bin/python -m ruff check .
	@$(RUN) .venv/bin/python -m ruff format --check .
	@$(RUN) .venv/bin/python -m mypy
	@$(RUN) .venv/bin/python docs/reference.py --check
	@$(RUN) .venv/bin/python -m pytest tests/architecture $(ARGS)

docs: ## the documentation as a site, in build/site; renews docs/configuration.md
	@$(RUN) .venv/bin/python docs/reference.py
	@$(RUN) .venv/bin/python -m sphinx -q -W --keep-going -c docs -d build/doctrees . build/site
	@echo "build/site/index.html"

format: ## sort imports, fix what can be fixed, format
	@$(RUN) .venv/bin/python -m ruff check --fix .
	@$(RUN) .venv/bin/python -m ruff format .

setup: ## only make .venv ready
	@$(RUN)

pins: ## refresh constraints.txt to the newest versions that fit pyproject.toml
	@$(RUN) bash .ci/pins.sh

release-check: ## wheel and sdist in empty environments, each extra, lowest versions (downloads, 15 minutes)
	@$(RUN) .venv/bin/python -m tests.release.check $(ARGS)

compatibility: ## run every command of LeRobot with the policy, write docs/compatibility.md (downloads, 10 minutes)
	@$(RUN) .venv/bin/python -m tests.release.compatibility $(ARGS)

clean: ## remove caches and build leftovers
	rm -rf build dist ./*.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -not -path './.venv/*' -not -path './.git/*' -prune -exec rm -rf {} +

distclean: clean ## remove .venv as well
	rm -rf .venv
