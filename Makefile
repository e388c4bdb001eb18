# Two commands do everything on a machine with Python 3.11 to 3.14: `make demo` and `make test`.
# Another interpreter: `make demo PYTHON=python3.12`.

PYTHON ?= $(firstword $(foreach name,python3.11 python3.12 python3.13 python3.14 python3,$(shell command -v $(name))))
VENV := .venv
BIN := $(VENV)/bin
# Processes that the tests are spread over; each needs some 1.2 GB.
WORKERS ?= 2
# Containers may ask Python to keep no bytecode: then every process compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE
# Python compiles of the packages what is imported; pip would compile all 13,000 files.
PIP := $(BIN)/python -m pip --disable-pip-version-check install --progress-bar off --no-compile

# The stamps lie in the environment and go with it. A change of pyproject.toml installs again.
INSTALLED := $(VENV)/.installed
INSTALLED_DEV := $(VENV)/.installed-dev

.PHONY: demo test lint style format docs clean
.DELETE_ON_ERROR:

demo: $(INSTALLED)
	$(BIN)/scanweave demo

# Types are checked meanwhile: that takes one core half a minute, where nothing of it is kept. In a fresh clone one
# process loads all first: Python compiles it for 12 s, which else each of the workers would do.
test: style
	@$(BIN)/mypy >$(VENV)/.types 2>&1 & types=$$!; \
	  test -d tests/__pycache__ || $(BIN)/python -m pytest --collect-only -qq >/dev/null 2>&1; \
	  $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal; tests=$$?; \
	  wait $$types; types=$$?; cat $(VENV)/.types; exit $$((tests | types))

lint: style
	$(BIN)/mypy

style: $(INSTALLED_DEV)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

format: $(INSTALLED_DEV)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(INSTALLED_DEV)
	$(BIN)/mkdocs build --strict
	@echo "open site/index.html"

clean:
	rm -rf $(VENV) build dist site out demo-out *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find slam fusion tests tools -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "no python3.11 to python3.14 found; set PYTHON=/path/to/one" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); \
	  echo "$(PYTHON) cannot make environments; on Debian: apt-get install python3-venv" >&2; exit 1; }

$(INSTALLED): pyproject.toml | $(BIN)/python
	$(PIP) -e .
	@touch $@

$(INSTALLED_DEV): pyproject.toml | $(BIN)/python
	$(PIP) -e '.[dev]'
	@touch $@ $(INSTALLED)
