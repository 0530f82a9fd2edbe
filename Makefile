# `make run` and `make test` create .venv with all requirements.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
LOCKED := --quiet --no-compile --require-hashes
REQUIREMENTS := --requirement requirements/core.txt --requirement requirements/dev.txt

.PHONY: run test test-slow test-long lint docs packages lock clean

run: $(VENV)/.core
	$(BIN)/hilctl run configs/demo.yaml

test: $(VENV)/.ready
	@echo "Takes 3 to 4 minutes of processor time on up to 4 cores. Complete runs: make test-slow."
	$(BIN)/pytest -n auto --maxprocesses 4 --dist loadfile -m "not slow"

test-slow: $(VENV)/.ready
	@echo "Takes about 12 minutes on two cores: complete runs, in separate processes."
	$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder -m "slow and not long"

test-long: $(VENV)/.ready
	@echo "Takes more than half an hour: campaigns, published values, rigs of other physics."
	$(BIN)/pytest -n 2 --dist loadfile -m long

lint: $(VENV)/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: $(VENV)/.ready
	$(PIP) install $(LOCKED) $(REQUIREMENTS) --requirement requirements/docs.txt
	$(BIN)/sphinx-build --fail-on-warning --keep-going --fresh-env --quiet docs docs/_build/html
	@echo "docs/_build/html/index.html"

# The pip of $(PYTHON), if it is 22.3 or newer, installs the locked pip with the rest:
# the pip of venv takes six seconds to unpack and compile.
$(VENV)/.core: pyproject.toml requirements/core.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "hilctl needs Python 3.11 or newer: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv --without-pip $(VENV)
	@pip="$(PYTHON) -m pip --python $(BIN)/python --disable-pip-version-check"; \
		$$pip --version >/dev/null 2>&1 || { $(PYTHON) -m venv $(VENV); pip="$(PIP)"; }; \
		$$pip install $(LOCKED) --requirement requirements/core.txt
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

$(VENV)/.ready: $(VENV)/.core requirements/dev.txt
	$(PIP) install $(LOCKED) $(REQUIREMENTS)
	@touch $@

packages: $(VENV)/.ready
	.ci/packages

# Lock the newest versions, by hash, for any system and Python >= 3.11; dev and docs hold what they add. It needs uv.
COMPILE := uv pip compile --universal --python-version 3.11 --generate-hashes --no-annotate --no-header --upgrade --quiet
TESTED := pyproject.toml --extra foxglove --extra parquet --extra scale --group dev
added_to = $$(sed -n 's/^\([^ =]*\)==.*/--no-emit-package \1/p' $(1))

lock:
	printf 'hatchling\npip\n' | $(COMPILE) pyproject.toml - --output-file requirements/core.txt
	$(COMPILE) $(TESTED) --constraint requirements/core.txt \
		$(call added_to,requirements/core.txt) --output-file requirements/dev.txt
	$(COMPILE) $(TESTED) --group docs --constraint requirements/core.txt --constraint requirements/dev.txt \
		$(call added_to,requirements/core.txt requirements/dev.txt) --output-file requirements/docs.txt

clean:
	rm -rf $(VENV) docs/_build docs/_generated .mypy_cache .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -prune -exec rm -rf {} +
