# make train   sets up .venv once, then trains: make train ARGS="worlds=256 iterations=100"
# make test    the tests, a process a core (up to 4): one alone, to debug it: make test ARGS="-n 0 -k name"
# make lint    ruff over everything, mypy over the package, the English, the results page
# make wheel   what `pip install` takes, in dist/
# make play    plays a policy: make play ARGS="checkpoint=checkpoints/grasp.pt"
# make docs    this documentation as a site, in out/site/
# Another Python: make train PYTHON=python3.12
# The packages are those of locks/, checked by their hashes; the newest that pyproject.toml allows: make train LOCK=

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	command -v $$p >/dev/null 2>&1 && \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' && { echo $$p; break; }; done)
VENV ?= .venv
LOCK ?= locks
PY := $(VENV)/bin/python
ARGS ?=

.PHONY: help train test lint wheel play docs

help:
	@sed -n 's/^# \{0,1\}//p' Makefile | head -8

train: $(VENV)/.installed
	$(PY) train.py $(or $(filter task=%,$(ARGS)),task=grasp) $(filter-out task=%,$(ARGS))

play: $(VENV)/.installed
	$(PY) play.py $(or $(ARGS),checkpoint=checkpoints/grasp.pt)

# The many programs that tests start read the package compiled, also where the shell asks for no such files
test: $(VENV)/.installed-test
	PYTHONDONTWRITEBYTECODE= $(PY) -m pytest -q -m "not slow" -n auto --maxprocesses 4 --dist worksteal $(ARGS)

lint: $(VENV)/.installed-test
	$(PY) -m ruff check .
	$(PY) -m mypy
	$(PY) -m tools.prose
	$(PY) -m tools.results check

wheel: $(VENV)/.installed
	$(PY) -m pip wheel --quiet --disable-pip-version-check --no-deps --wheel-dir dist .

docs: $(VENV)/.installed-docs
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict

PIP := $(PY) -m pip install --quiet --disable-pip-version-check
# $(call install,LOCK,EXTRAS): what is locked first; then dexsim itself, and what its ranges need beside, if anything.
# torch comes as its CPU build where there is no NVIDIA GPU and pip finds that build.
define install
$(if $(LOCK),$(PIP) --no-deps --require-hashes -r $(LOCK)/$(1).txt)
$(if $(LOCK),@$(PY) -c 'import torch' 2>/dev/null || { ! [ -e /dev/nvidiactl ] && \
	$(PIP) --no-deps --require-hashes -r $(LOCK)/torch-cpu.txt 2>/dev/null; } || \
	$(PIP) --no-deps --require-hashes -r $(LOCK)/torch.txt)
$(PIP) $(if $(LOCK),--no-build-isolation) -e ".$(2)"
endef

# Installed again only when pyproject.toml or the lock changes.
$(VENV)/.installed: pyproject.toml $(wildcard locks/base.txt) | $(PY)
	$(call install,base,)
	@touch $@

$(VENV)/.installed-test: pyproject.toml $(wildcard locks/test.txt) | $(PY)
	$(call install,test,[test])
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-docs: pyproject.toml $(wildcard locks/docs.txt) | $(PY)
	$(call install,docs,[docs])
	@touch $@ $(VENV)/.installed

$(PY):
	@test -n "$(PYTHON)" || \
		{ echo "error: dexsim needs Python 3.11 or newer; none found (PYTHON=/path/to/python names one)"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "error: dexsim needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) -V)"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || \
		{ rm -rf $(VENV); \
		  echo "error: $(PYTHON) cannot make a virtual environment (Debian, Ubuntu: apt-get install python3-venv)"; exit 1; }
