# The two commands: `make run` and `make test`. Each sets up all that it needs in .venv.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: run test test-slow test-long lint clean

run: $(VENV)/.ready
	$(BIN)/hilctl run configs/demo.yaml

test: $(VENV)/.ready
	@echo "Takes 4 to 5 minutes of processor time, shared by up to 4 cores; whole runs: make test-slow."
	$(BIN)/pytest -n auto --maxprocesses 4 --dist loadfile -m "not slow"

test-slow: $(VENV)/.ready
	@echo "Takes about 12 minutes on two cores: whole runs, in processes of their own."
	$(BIN)/pytest -n 2 --dist loadfile -m "slow and not long"

test-long: $(VENV)/.ready
	@echo "Takes more than half an hour: campaigns, published figures, rigs of other physics, and what repeats other runs."
	$(BIN)/pytest -n 2 --dist loadfile -m long

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

$(VENV)/.ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "hilctl needs Python 3.11 or newer: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --constraint constraints.txt --editable '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
