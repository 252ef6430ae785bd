# make demo: images in, 3D model out.   make test: everything that is checked before a change lands.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

# Kernels and modules are compiled once, for all processes of the tests: a setting that keeps Python from saving bytecode would have each
# of them compile the package again.
unexport PYTHONDONTWRITEBYTECODE
WARM_UP := $(BIN)/python tests/warm_up.py

.PHONY: demo test test-whole docs test-numba fuzz clean

demo: $(STAMP)
	$(BIN)/epipole demo

test: $(STAMP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports
	$(BIN)/mypy & types=$$!; NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet & site=$$!; \
		$(WARM_UP) && wait $$types && wait $$site
	$(BIN)/python -m pytest -n 2 --dist loadfile

# All combinations of inputs, of which `make test` takes a sample.
test-whole: $(STAMP)
	$(WARM_UP)
	EPIPOLE_WHOLE_TESTS=1 $(BIN)/python -m pytest -n 2 --dist loadfile

# The pages under docs/, the command line, the API and the benchmarks as a site in build/site, which opens from disk.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# Kernels on the oldest Numba that is allowed and on the newest there is, each in an environment of its own.
NUMBA_TESTS := tests/test_jit.py tests/test_kernel_modes.py tests/test_simd.py tests/robust tests/optim
test-numba: .venv-oldest/.installed .venv-newest/.installed
	EPIPOLE_WHOLE_TESTS=1 .venv-oldest/bin/python -m pytest $(NUMBA_TESTS)
	EPIPOLE_WHOLE_TESTS=1 .venv-newest/bin/python -m pytest $(NUMBA_TESTS)

# Damaged files for every reader, wrong arguments for every function, jobs that are killed or out of space, two at once; what is
# found is printed with its seed and case.
CASES ?= 100000
SEED ?= 0
fuzz: $(STAMP)
	$(BIN)/python -m tests.fuzz.run --cases $(CASES) --seed $(SEED)
	$(BIN)/python -m tests.fuzz.wrong_calls --cases $(CASES)
	$(BIN)/python -m tests.fuzz.interruptions
	$(BIN)/python -m tests.fuzz.interruptions --random 40
	$(BIN)/python -m tests.fuzz.two_processes

.venv-oldest/.installed: CHOICE := numba==0.61.*
.venv-newest/.installed: CHOICE := --upgrade numba
.venv-oldest/.installed .venv-newest/.installed: pyproject.toml
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check -e '.[dev]' $(CHOICE)
	touch $@

clean:
	rm -rf $(VENV) .venv-oldest .venv-newest demo build dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache
	rm -rf src/*.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# Installed once, and again when the dependencies change.
$(STAMP): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "Python 3.11 or newer is needed: make PYTHON=python3.12 ..."; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $(STAMP)
