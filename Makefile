# Every target does its own set-up: .venv in this folder, from uv.lock. Only Python 3.11+ and pip are needed.

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
DOCS_READY := .venv/.ready-docs
WARP_READY := .venv/.ready-warp
EXTRAS := --all-extras
SYNC := UV_PROJECT_ENVIRONMENT=.venv UV_PYTHON_DOWNLOADS=never UV_COMPILE_BYTECODE=1 VIRTUAL_ENV= $(BIN)/uv sync --locked --inexact --quiet

.PHONY: demo test night bench figures docs format wheel

demo: $(READY)
	$(BIN)/sim2real demo

# The gate. Types are checked beside the tests, in one thread: with two, pyright takes half as much processor time again.
# Its priority is low, so that it ends beside the tests with real processes, which mostly wait. These run one after
# another; one that fails is repeated once.
PYTEST := $(BIN)/python -m pytest
PROCESS := $(PYTEST) $$(grep -rl --include="*.py" mark.process tests) -m "process and not night"
test: $(READY)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports --no-cache --no-logo
	@nice -n 8 $(BIN)/pyright > .venv/pyright.log 2>&1 & types=$$!; \
	$(PYTEST) -m "not process and not night" --numprocesses 2 --dist loadfile --no-loadscope-reorder && \
	{ $(PROCESS) || $(PROCESS) --last-failed --last-failed-no-failures none; }; tests=$$?; \
	wait $$types; types=$$?; echo "pyright:"; cat .venv/pyright.log; \
	[ $$tests = 0 ] && [ $$types = 0 ]

# What blocks nothing: long tests, those that depend on chance, and drawn examples from a new seed, on which no test ends
# the others. SEED=N repeats a night.
SEED ?= $(shell date +%s)
night: $(WARP_READY)
	@echo "SEED=$(SEED)"
	$(PYTEST) -m "(night or hypothesis) and not process" --numprocesses 2 --dist loadfile \
	  --hypothesis-profile=night --hypothesis-seed=$(SEED); tests=$$?; \
	$(PYTEST) -m "night and process"; process=$$?; \
	$(BIN)/python scripts/canary.py $(if $(DATA),--data $(DATA)); canary=$$?; \
	[ $$tests = 0 ] && [ $$process = 0 ] && [ $$canary = 0 ]

# Short benches beside the committed reports, 10 to 15 minutes; DATA=DIR adds the recordings of real motors.
bench: $(READY)
	$(BIN)/python scripts/canary.py $(if $(DATA),--data $(DATA))

# The tables of README.md and docs/, and README's figures, from reports/.
figures: $(READY)
	$(BIN)/python scripts/figures.py

docs: $(DOCS_READY)
	$(BIN)/python -m sphinx --fail-on-warning --keep-going -q -b html docs docs/_build/html
	@echo "wrote docs/_build/html/index.html"

wheel: $(READY)
	@rm -rf dist
	@{ $(BIN)/python -m build --outdir dist . && $(BIN)/python -m build --wheel --outdir dist packaging/robot; } \
	  > dist.log 2>&1 || { cat dist.log >&2; exit 1; }
	@rm dist.log
	@for file in dist/*; do echo "wrote $$file"; done

format: $(READY)
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# uv and pip stay in .venv beside what uv.lock lists: hence --inexact.
# Where packages come from a mirror that only pip is configured for, pip installs the same versions by their hashes.
define INSTALL
	@$(SYNC) $(EXTRAS) $(1) || { \
	  echo "uv cannot reach the package index: installing the locked versions with pip" >&2; \
	  $(BIN)/uv export --frozen --offline --quiet $(EXTRAS) $(1) --no-dev --no-emit-project -o .venv/requirements.txt && \
	  $(BIN)/python -m pip install --quiet --no-deps -r .venv/requirements.txt && \
	  $(BIN)/python -m pip install --quiet --no-deps --editable .; }
	@touch $@
endef

# Warp's wheel has 149 MB, and is needed by the tests of `night` only.
$(READY): pyproject.toml uv.lock | $(BIN)/uv
	@echo "setting up .venv from uv.lock" >&2
	$(call INSTALL,--no-extra warp)

$(WARP_READY): $(READY)
	$(call INSTALL)

$(DOCS_READY): $(READY)
	@$(SYNC) $(EXTRAS) --no-extra warp --group docs || $(BIN)/python -m pip install --quiet sphinx furo myst-parser
	@touch $@

$(BIN)/uv: | $(BIN)/pip
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check uv

# Some distributions split ensurepip off: then the pip of $(PYTHON) installs one into the environment.
$(BIN)/pip:
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.exit(None if sys.version_info >= (3, 11) else \
	  f"error: sim2real needs Python 3.11 or newer, $(PYTHON) is {v}\n\nhint: make PYTHON=python3.11")'
	@$(PYTHON) -m venv .venv || { $(PYTHON) -m venv --clear --without-pip .venv && \
	  $(PYTHON) -m pip --python $(BIN)/python install --quiet pip; }
